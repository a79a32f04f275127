"""Time and memory of a setting."""

from dataclasses import dataclass
from time import perf_counter, thread_time

import numpy as np

from xpbd_ros.study.accuracy.baselines import Baseline
from xpbd_ros.study.cost.measure import array_bytes

ENOUGH_S, LEAST_FRAMES = 2.0, 60
"""a timing ends with the run, or once it has so many seconds and frames and is SLOW"""
SLOW = 2.0
"""time of the frames so far over their simulated time; others are timed to the end, as frames may
take longer once cloth touches"""


@dataclass(frozen=True)
class Timing:
    """Time and memory of one setting."""

    ms_p50: float
    """median CPU time per frame [ms]"""
    ms_p95: float
    """95th percentile of the CPU time per frame [ms]"""
    real_time_factor: float
    """simulated time over wall time"""
    frames: int
    """number of timed frames"""
    bytes: int
    """size of all arrays of the simulation [bytes]"""
    cpu_share: float = 1.0
    """CPU time over wall time; 1 on an idle machine"""


def time_frames(simulation, frames: int, commands: dict[int, list]) -> Timing:
    """Time the frames of a simulation from its start; ``commands`` are its inputs by frame."""
    simulation.compile()
    taken = []
    start, cpu = perf_counter(), thread_time()
    with np.errstate(all='ignore'):
        for frame in range(1, frames + 1):
            inputs, before = commands.get(frame, ()), thread_time()
            simulation.step(inputs)
            taken.append(1e3 * (thread_time() - before))
            used = 1e-3 * sum(taken)
            if used > max(ENOUGH_S, SLOW * frame * simulation.frame_dt) and frame >= LEAST_FRAMES:
                break
    wall, cpu = perf_counter() - start, thread_time() - cpu
    return Timing(float(np.percentile(taken, 50)), float(np.percentile(taken, 95)),
                  len(taken) * simulation.frame_dt / wall, len(taken), memory(simulation),
                  cpu / wall)


def memory(simulation) -> int:
    """Return the size of all arrays that a simulation computes with [bytes]."""
    if isinstance(simulation, Baseline):
        return simulation.bytes
    return array_bytes((simulation.state, *(built.parts for built in simulation.effects.values())),
                       set())
