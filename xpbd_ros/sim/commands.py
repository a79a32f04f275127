"""
What may be asked of a simulation between two frames: plain values, no messages.

Positions are in metres, orientations are unit quaternions (x, y, z, w), in the scene's frame.
A command is either applied as it stands or refused with a reason; applied commands and the frames
they acted on are all that is needed to repeat a run.
"""

from dataclasses import dataclass
from typing import Any

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """A place and an orientation."""

    position: Vector = (0.0, 0.0, 0.0)
    """[m]"""
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """unit quaternion x, y, z, w"""


@dataclass(frozen=True)
class Twist:
    """A linear and an angular velocity, world axes."""

    linear: Vector = (0.0, 0.0, 0.0)
    """[m/s]"""
    angular: Vector = (0.0, 0.0, 0.0)
    """[rad/s]"""


@dataclass(frozen=True)
class Grasp:
    """Pin all free particles within a radius of a point; a pin that holds already moves there."""

    pin: str
    pose: Pose
    radius: float
    """[m]"""
    lifetime_ns: int = 0
    """the pin lets go by itself after this long without a new grasp [ns]; 0: never"""


@dataclass(frozen=True)
class Release:
    """Let go of what a pin holds; its particles get their mass back."""

    pin: str


@dataclass(frozen=True)
class ReleaseAll:
    """Let go of everything."""


@dataclass(frozen=True)
class MovePin:
    """Where a pin goes."""

    pin: str
    pose: Pose
    twist: Twist | None = None
    stamp_ns: int = 0
    """when the sender says that it is there [ns]; 0: unknown"""


@dataclass(frozen=True)
class MoveCollider:
    """Where a collider goes."""

    collider: str
    pose: Pose
    twist: Twist | None = None
    """velocity of its surface; None: taken from the poses"""
    stamp_ns: int = 0


@dataclass(frozen=True)
class PlaceCollider:
    """Add a collider; one that is there already takes this shape and goes there."""

    collider: str
    shape: str
    """box, sphere, cylinder or mesh"""
    size: tuple[float, ...]
    """[m]: full extents; radius; radius and length along z; x y z of each triangle's corners"""
    pose: Pose
    lifetime_ns: int = 0
    """it goes away by itself after this long without a new one [ns]; 0: never"""


@dataclass(frozen=True)
class RemoveCollider:
    """Take a collider away."""

    collider: str


@dataclass(frozen=True)
class RemoveAllColliders:
    """Take all colliders away, those of the scene too."""


@dataclass(frozen=True)
class SetWind:
    """How the air moves from now on."""

    velocity: Vector
    """[m/s]"""


@dataclass(frozen=True)
class SetKey:
    """Change one live key of the scene, such as ``solver.substeps``."""

    key: str
    value: Any


@dataclass(frozen=True)
class Reset:
    """Back to the scene's start; time goes on rising."""


Command = (Grasp | Release | ReleaseAll | MovePin | MoveCollider | PlaceCollider | RemoveCollider
           | RemoveAllColliders | SetWind | SetKey | Reset)
