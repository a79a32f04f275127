"""Cloth for robots: an XPBD simulation, and a ROS 2 node that steps it."""

from typing import Any

__version__ = '0.1.0'

__all__ = [
    'Click', 'Frame', 'Grasp', 'InputError', 'LoadState', 'MoveCollider', 'MovePin',
    'PlaceCollider', 'Pose', 'Release', 'ReleaseAll', 'RemoveAllColliders', 'RemoveCollider',
    'Reset', 'SaveState', 'SetKey', 'SetState', 'SetWind', 'Simulation', 'State', 'Twist', 'load',
    'rollouts']


def __getattr__(name: str) -> Any:
    """Import the simulation with the first name that is asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'xpbd_ros' has no attribute '{name}'")
    from xpbd_ros import api
    return getattr(api, name)


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__, '__version__']
