"""A pin or a collider in one frame of a run."""

from typing import NamedTuple


class Body(NamedTuple):
    """A pin that holds, or a collider, in one frame."""

    name: str
    position: tuple[float, float, float]
    """[m]"""
    orientation: tuple[float, float, float, float]
    """x, y, z, w"""
    force: tuple[float, float, float]
    """of the cloth on it [N]"""
    torque: tuple[float, float, float]
    """about its position [N m]"""
