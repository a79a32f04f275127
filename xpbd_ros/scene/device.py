"""Scenes for a GPU (``solver.device: cuda``): what they may ask for, and the card."""

from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.stepping.methods import METHODS


def card_of(scene: Scene) -> Any:
    """Return the card that a scene asks for, None for the CPU; raise InputError if it cannot."""
    if scene.top.solver.device != 'cuda':
        return None
    try:
        check(scene)
        from xpbd_ros.sim.backend.cuda import Card
        return Card()
    except InputError as error:
        raise InputError(f'{scene.where}: {error}') from None


def check(scene: Scene) -> None:
    """Raise InputError if a GPU cannot compute a scene, with the way out."""
    solver = scene.top.solver
    if solver.method == 'auto':
        raise InputError('solver.method: auto predicts the times of a CPU; for '
                         f'solver.device: cuda take one of {", ".join(METHODS)}')
    if solver.order != 'coloured':
        raise InputError('solver.device: cuda sweeps constraints by colours; add solver.order: '
                         'coloured')
    if solver.error_target is not None:
        raise InputError('solver.error_target: changes substeps as it runs, and those of a GPU '
                         'are fixed; leave it out, or take solver.device: cpu')
