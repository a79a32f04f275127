"""
The effects, in projection order: this order is physics, so it is readable in one place.

Soft before stiff, contact and friction last: what is projected last holds best. An effect's module
is imported only when a scene names it.
"""

import importlib

from xpbd_ros.errors import InputError
from xpbd_ros.sim.effect import Effect

EFFECTS = {
    'pin': 'scene',
    'wind': 'scene',
    'drag': 'scene',
    'force': 'scene',
    'damping': 'scene',
    'rayleigh': 'cloth',
    'bend': 'cloth',
    'cross_bend': 'cloth',
    'hinge': 'cloth',
    'volume': 'cloth',
    'area': 'cloth',
    'pressure': 'cloth',
    'shear': 'cloth',
    'membrane': 'cloth',
    'stretch': 'cloth',
    'tether': 'cloth',
    'strain_limit': 'cloth',
    'seam': 'scene',
    'self_collision': 'scene',
    'contact': 'scene',
    'friction': 'scene',
}
"""name: what it belongs to"""

SECTIONS = {'pins': 'pin', 'colliders': 'contact', 'seams': 'seam'}
"""sections of a scene, and the effect that each belongs to"""


def load(name: str) -> Effect:
    """Import one effect's module and return what it registers."""
    try:
        return importlib.import_module(f'xpbd_ros.effects.{name}').EFFECT
    except ModuleNotFoundError as error:
        raise InputError(f'effects.{name}: this installation has no such effect '
                         f'({error})') from error
