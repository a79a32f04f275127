"""
The effects of the package, in projection order.

The order is part of the physics: soft before stiff, contact and friction last, since the last
projection holds best. An effect's module is imported only if a scene names the effect.
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
"""name: the section that it stands in, each cloth or the scene"""

SECTIONS = {'pins': 'pin', 'colliders': 'contact', 'seams': 'seam'}
"""sections of a scene file, and the effect that reads each of them"""


def load(name: str) -> Effect:
    """Import one effect's module and return its ``EFFECT``."""
    try:
        return importlib.import_module(f'xpbd_ros.effects.{name}').EFFECT
    except ModuleNotFoundError as error:
        raise InputError(f'effects.{name}: this installation has no such effect '
                         f'({error})') from error
