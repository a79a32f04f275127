"""What a setting takes: time of a frame, memory."""

from dataclasses import dataclass
from time import perf_counter, thread_time

import numpy as np

from xpbd_ros.study.accuracy.baselines import Baseline
from xpbd_ros.study.cost.measure import array_bytes

ENOUGH_S, LEAST_FRAMES = 2.0, 60
"""a setting is timed for the whole run, or until both are reached"""


@dataclass(frozen=True)
class Timing:
    """Time and memory of one setting."""

    ms_p50: float
    """CPU time of a frame: median [ms]"""
    ms_p95: float
    real_time_factor: float
    """simulated over wall time"""
    frames: int
    """that were timed"""
    bytes: int
    """of all arrays of the simulation"""
    cpu_share: float = 1.0
    """CPU time over wall time: 1 where nothing else was running"""


def time_frames(simulation, frames: int, commands: dict[int, list]) -> Timing:
    """Run a simulation from its start, with nothing beside it."""
    simulation.compile()
    taken = []
    start, cpu = perf_counter(), thread_time()
    with np.errstate(all='ignore'):
        for frame in range(1, frames + 1):
            inputs, before = commands.get(frame, ()), thread_time()
            simulation.step(inputs)
            taken.append(1e3 * (thread_time() - before))
            if perf_counter() - start > ENOUGH_S and frame >= LEAST_FRAMES:
                break
    wall, cpu = perf_counter() - start, thread_time() - cpu
    return Timing(float(np.percentile(taken, 50)), float(np.percentile(taken, 95)),
                  len(taken) * simulation.frame_dt / wall, len(taken), memory(simulation),
                  cpu / wall)


def memory(simulation) -> int:
    """Return the bytes of all arrays that a simulation computes with."""
    if isinstance(simulation, Baseline):
        return simulation.bytes
    return array_bytes((simulation.state, *(built.parts for built in simulation.effects.values())),
                       set())
