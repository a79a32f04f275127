"""The energy of a cloth in each frame of a log."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from xpbd_ros.sim.commands import Command, LoadState, Reset, SetKey, SetState
from xpbd_ros.sim.measure import elastic_energy, kinetic_energy, potential_energy
from xpbd_ros.sim.simulation import Simulation

JUMPS = Reset, LoadState, SetState
"""commands that place particles elsewhere"""


def energy_now(simulation: Simulation) -> dict[str, float]:
    """Return the parts of the present energy [J]."""
    return {'kinetic': kinetic_energy(simulation.state),
            'potential': potential_energy(simulation.state),
            'elastic': elastic_energy(simulation)}


def logged_energy(simulation: Simulation, commands: Mapping[int, Sequence[Command]],
                  frames: Sequence[int], times: np.ndarray, positions: Sequence[np.ndarray],
                  numbers: Iterable[int]) -> dict[str, np.ndarray]:
    """
    Return the parts of the energy in each frame [J].

    A log has no velocities, so those of the kinetic energy are central differences of the
    positions, one-sided next to a reset. Masses and stiffnesses are the scene's, with the live
    keys of each frame.

    Parameters
    ----------
    simulation : of the log's scene, at its start; its state changes
    commands : inputs by frame
    frames, times : indices and times [s] of the frames
    positions : by cloth [m], shape (frames, particles, 3)
    numbers : counts the frames from 0 on

    """
    jumps = np.array(sorted(frame for frame, these in commands.items()
                            if any(isinstance(each, JUMPS) for each in these)))
    part = np.searchsorted(jumps, frames, side='right')    # runs of frames without a jump
    keys = [(frame, each) for frame in sorted(commands) for each in commands[frame]
            if isinstance(each, SetKey) and frame > frames[0]]
    found: dict[str, list[float]] = {}
    state, slot, done = simulation.state, simulation.slot, 0
    for k in numbers:
        while done < len(keys) and keys[done][0] <= frames[k]:
            simulation.apply([keys[done][1]])
            done += 1
        before, after = (j if 0 <= j < len(frames) and part[j] == part[k] else k
                         for j in (k - 1, k + 1))
        now, earlier, later = (np.concatenate([x[j] for x in positions]).astype(float)
                               for j in (k, before, after))
        state.x[:, slot] = now.T
        if after > before:
            state.v[:, slot] = ((later - earlier) / (times[after] - times[before])).T
        else:
            state.v[:, slot] = np.nan
        for name, value in energy_now(simulation).items():
            found.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in found.items()}
