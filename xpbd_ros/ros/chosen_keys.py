"""What ``auto`` chose while running, as commands of a log, which does not choose again."""

from dataclasses import replace
from typing import Any

from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.simulation import Frame
from xpbd_ros.sim.stepping.solver import Solver


def chosen_keys(solver: Solver) -> dict[str, Any]:
    """Return what ``auto`` may have chosen for a running simulation, by key."""
    if solver.mixes:
        return {'solver.substeps': solver.substeps,
                'solver.rough_substeps': solver.rough.substeps,
                'solver.rough_integrator': solver.rough.integrator}
    return {'solver.substeps': solver.substeps, 'solver.integrator': solver.integrator}


def with_chosen_keys(frame: Frame, asked: dict[str, Any], chosen: dict[str, Any]) -> Frame:
    """
    Return a frame that also records what ``auto`` chose after a key changed.

    The log's scene has ``auto`` resolved, so a repeated run does not choose again.
    """
    others = tuple(SetKey(key, count) for key, count in chosen.items() if count != asked.get(key))
    return replace(frame, applied=(*frame.applied, *others)) if others else frame
