"""
Commands that a simulation takes between two frames: frozen dataclasses, independent of ROS.

Positions are in metres and orientations are unit quaternions (x, y, z, w), both in the scene's
TF frame. A command is either applied unchanged or refused with a reason. A run is repeated from
its scene, the applied commands and the index of the frame before which each was applied.
"""

from dataclasses import dataclass
from typing import Any

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a rigid body."""

    position: Vector = (0.0, 0.0, 0.0)
    """[m]"""
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """unit quaternion x, y, z, w"""


@dataclass(frozen=True)
class Twist:
    """Linear and angular velocity in world axes."""

    linear: Vector = (0.0, 0.0, 0.0)
    """[m/s]"""
    angular: Vector = (0.0, 0.0, 0.0)
    """[rad/s]"""


@dataclass(frozen=True)
class Grasp:
    """Pin all free particles within a radius of a point; move the pin if it is already active."""

    pin: str
    pose: Pose
    radius: float
    """[m]"""
    lifetime_ns: int = 0
    """the pin is released after this time without another grasp [ns]; 0: never"""


@dataclass(frozen=True)
class Click:
    """Pin the particle nearest to a point; release the pin that holds it if there is one."""

    point: Vector
    """[m]"""


@dataclass(frozen=True)
class Release:
    """Release a pin; its particles regain their inverse mass."""

    pin: str


@dataclass(frozen=True)
class ReleaseAll:
    """Release all pins."""


@dataclass(frozen=True)
class MovePin:
    """Set the target of a pin."""

    pin: str
    pose: Pose
    twist: Twist | None = None
    stamp_ns: int = 0
    """sender's time at which the pin is at the pose [ns]; 0: unknown"""


@dataclass(frozen=True)
class MoveCollider:
    """Set the target of a collider."""

    collider: str
    pose: Pose
    twist: Twist | None = None
    """velocity of the collider; None: from the difference of poses"""
    stamp_ns: int = 0
    """sender's time at which the collider is at the pose [ns]; 0: unknown"""


@dataclass(frozen=True)
class PlaceCollider:
    """Add a collider; an existing one of this name takes the new shape and pose."""

    collider: str
    shape: str
    """box, sphere, cylinder or mesh"""
    size: tuple[float, ...]
    """
    [m]: full extents of a box; radius of a sphere; radius and length along z of a cylinder;
    x, y, z of each triangle's corners of a mesh
    """
    pose: Pose
    lifetime_ns: int = 0
    """the collider is removed after this time without another command [ns]; 0: never"""


@dataclass(frozen=True)
class RemoveCollider:
    """Remove a collider."""

    collider: str


@dataclass(frozen=True)
class RemoveAllColliders:
    """Remove all colliders, those of the scene included."""


@dataclass(frozen=True)
class SetWind:
    """Set the velocity of the air."""

    velocity: Vector
    """[m/s]"""


@dataclass(frozen=True)
class SetKey:
    """Change one live scene key, such as ``solver.substeps``."""

    key: str
    value: Any


@dataclass(frozen=True)
class Reset:
    """Restore the scene's initial state; simulation time continues to rise."""


@dataclass(frozen=True)
class SaveState:
    """Keep the present state in memory, for ``LoadState``."""


@dataclass(frozen=True)
class LoadState:
    """
    Restore the state of the last ``SaveState``; simulation time continues to rise.

    Live keys keep their present values.
    """


@dataclass(frozen=True)
class SetState:
    """Place the free particles of a cloth, at rest; pinned particles stay at their pins."""

    cloth: str
    positions: tuple[float, ...]
    """x, y, z of each particle in natural order [m]; an array (particles, 3) is taken as well"""


Command = (Grasp | Click | Release | ReleaseAll | MovePin | MoveCollider | PlaceCollider
           | RemoveCollider | RemoveAllColliders | SetWind | SetKey | Reset | SaveState | LoadState
           | SetState)
