"""Scenes for a GPU (``solver.device: cuda``): what they may ask for, and the card."""

from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.model import Scene

EFFECTS = ('pin', 'wind', 'drag', 'force', 'damping', 'rayleigh', 'bend', 'cross_bend', 'hinge',
           'volume', 'area', 'pressure', 'shear', 'membrane', 'stretch', 'tether', 'strain_limit',
           'seam', 'contact', 'friction')
"""effects whose kernels have the CPU's bits as PTX (test/sim/test_device_effects.py)"""
METHODS = ('gauss_seidel', 'gauss_seidel_symmetric', 'jacobi', 'line')


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
    if solver.method not in METHODS:
        raise InputError(f'solver.method: {solver.method} does not run on a GPU; take one of '
                         f'{", ".join(METHODS)}, or solver.device: cpu')
    if solver.order != 'coloured':
        raise InputError('solver.device: cuda sweeps constraints by colours; add solver.order: '
                         'coloured')
    if solver.error_target is not None:
        raise InputError('solver.error_target: changes substeps as it runs, and those of a GPU '
                         'are fixed; leave it out, or take solver.device: cpu')
    pullers = [name for name in ('seam', 'contact') if name in scene.effect_names]
    if 'strain_limit' in scene.effect_names and pullers:
        raise InputError('solver.device: cuda has strain_limit only without seam and contact, '
                         f'with which it takes turns (got {" and ".join(pullers)}); leave it out, '
                         'or take device: cpu')
    others = [name for name in scene.effect_names if name not in EFFECTS]
    if others:
        raise InputError(f'solver.device: cuda does not have the effects {", ".join(others)} yet '
                         f'(it has {", ".join(EFFECTS)}); leave them out, or take device: cpu')
