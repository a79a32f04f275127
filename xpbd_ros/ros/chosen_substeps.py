"""The substeps that ``auto`` chose, as commands of a log, which does not choose again."""

from dataclasses import replace

from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.simulation import Frame
from xpbd_ros.sim.stepping.solver import Solver


def chosen_substeps(solver: Solver) -> dict[str, int]:
    """Return the numbers of substeps that ``auto`` may have chosen, by key."""
    found = {'solver.substeps': solver.substeps}
    if solver.mixes:
        found['solver.rough_substeps'] = solver.rough.substeps
    return found


def with_chosen_substeps(frame: Frame, asked: dict[str, int], chosen: dict[str, int]) -> Frame:
    """
    Return a frame that also records the substeps that ``auto`` chose after a key changed.

    The log's scene has ``auto`` resolved, so a repeated run does not choose again.
    """
    others = tuple(SetKey(key, count) for key, count in chosen.items() if count != asked.get(key))
    return replace(frame, applied=(*frame.applied, *others)) if others else frame
