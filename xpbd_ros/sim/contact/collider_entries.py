"""Collider entries of a scene: shape, pose, surface and motion."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.contact.colliders import BOX, CAPSULE, CYLINDER, HEIGHTS, MESH, PLANE, SPHERE
from xpbd_ros.sim.geometry.quaternion import from_z_axis, multiply
from xpbd_ros.sim.parameters import check_frame, check_static, quantity
from xpbd_ros.sim.target_motion import check_motion


@dataclass(frozen=True)
class Plane:
    """The half space below a plane."""

    normal: tuple[float, float, float] = quantity((0.0, 0.0, 1.0), doc='pointing out of it')

    def __post_init__(self):
        """Raise InputError for a zero vector."""
        if not any(self.normal):
            raise InputError('normal: must not be zero')


@dataclass(frozen=True)
class Sphere:
    """A sphere around the position."""

    radius: float = quantity(unit='m', above=0.0)


@dataclass(frozen=True)
class Capsule:
    """A sphere swept along z."""

    radius: float = quantity(unit='m', above=0.0)
    length: float = quantity(unit='m', minimum=0.0, doc='between the centres')


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z."""

    radius: float = quantity(unit='m', above=0.0)
    length: float = quantity(unit='m', above=0.0)


@dataclass(frozen=True)
class Box:
    """A box."""

    size: tuple[float, float, float] = quantity(unit='m', above=0.0, doc='full extents')


@dataclass(frozen=True)
class Body:
    """The interior of a closed triangle mesh."""

    file: str = quantity(doc='beside the scene file, or an absolute path')
    scale: float = quantity(1.0, above=0.0, doc="metres in the file's unit")
    spacing: float | None = quantity(None, unit='m', above=0.0, doc=(
        'of the grid of distances; unless given the thickness, or a 96th of the longest side, or '
        'as much less as its thinnest part takes'))


@dataclass(frozen=True)
class Ground:
    """The region below a height field; beyond its boundary the height is constant."""

    size: tuple[float, float] = quantity(unit='m', above=0.0, doc='extent along x, y')
    values: tuple[tuple[float, ...], ...] | None = quantity(
        None, unit='m', doc='rows from -y to +y, each from -x to +x')
    file: str | None = quantity(None, doc='or a .npy or .csv file with the same rows')
    scale: float = quantity(1.0, doc='metres in the unit of the heights')

    def __post_init__(self):
        """Raise InputError unless exactly one of file and (valid) values is given."""
        if (self.values is None) == (self.file is None):
            raise InputError("needs either 'values' or 'file', and only one of them")
        if self.values is not None:
            table(self.values)


def table(rows) -> np.ndarray:
    """Return heights as an array; raise InputError unless they are a finite table."""
    try:
        found = np.array(rows, float)
    except ValueError:
        raise InputError('values: must be rows of equal length') from None
    if found.ndim != 2 or min(found.shape) < 2:
        raise InputError(f'must be at least 2 rows of 2 heights (got {found.shape})')
    if not np.isfinite(found).all():
        raise InputError('has heights that are not finite')
    return found


@dataclass(frozen=True)
class Pad:
    """An elastic foundation on the surface, such as the rubber of a finger."""

    stiffness: float = quantity(unit='Pa/m', above=0.0, live=True, doc=(
        "pressure over indentation: the rubber's modulus over its thickness"))


@dataclass(frozen=True)
class Start:
    """Initial pose of a collider that follows a TF frame."""

    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m')
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')


@dataclass(frozen=True)
class Entry:
    """One entry of the scene's ``colliders``: exactly one shape, its pose and surface."""

    plane: Plane | None = quantity(None, doc='the half space below a plane')
    sphere: Sphere | None = quantity(None, doc='around the position')
    capsule: Capsule | None = quantity(None, doc='along its z, around the position')
    cylinder: Cylinder | None = quantity(None, doc='along its z, around the position')
    box: Box | None = quantity(None, doc='around the position')
    mesh: Body | None = quantity(None, doc='the interior of a closed surface')
    heights: Ground | None = quantity(None, doc='the region below a height field')
    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m',
                                                    doc="of the shape's or the file's origin")
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')
    friction: float = quantity(0.5, minimum=0.0, live=True, doc='coefficient μ')
    static_friction: float | None = quantity(
        None, minimum=0.0, live=True, doc='coefficient while it sticks; friction unless given')
    restitution: float = quantity(0.0, minimum=0.0, maximum=1.0,
                                  doc='speed after a bounce / speed before')
    pad: Pad | None = quantity(None, doc='a soft surface; rigid unless given')
    motion: tuple[tuple[float, ...], ...] | None = quantity(
        None, unit='s, m', doc='points [t, x, y, z] in place of position, joined by monotone '
        'cubics; at rest before the first and after the last')
    frame: str | None = quantity(None, doc=(
        'TF frame that it follows, with position and orientation in that frame'))
    start: Start | None = quantity(None, doc='its pose where there is no TF')
    frame_timeout: float | None = quantity(None, unit='s', above=0.0, doc=(
        'silence of the frame after which it is reported; 1 s unless given'))
    max_speed: float = quantity(5.0, unit='m/s', above=0.0, doc='it follows no faster')

    def __post_init__(self):
        """Raise InputError unless exactly one shape is given and the other values are valid."""
        given = [name for name in SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(f'needs exactly one shape of {", ".join(SHAPES)} '
                             f'(got {", ".join(given) or "none"})')
        check_static(self.static_friction, self.friction)
        check_motion(self.motion)
        check_frame(self)
        if self.motion and any(self.position) and self.position != self.motion[0][1:]:
            raise InputError("position: has no effect beside 'motion', whose points are "
                             'positions; leave it out')
        if self.start is not None and self.frame is None:
            raise InputError("start: needs 'frame', the TF frame to follow")
        if self.pad is not None and self.restitution > 0.0:
            raise InputError(f'restitution: must be 0 beside a pad (got {self.restitution:g}); '
                             'leave out one of the two')

    @property
    def shape(self) -> str:
        """Name of its shape."""
        return next(name for name in SHAPES if getattr(self, name) is not None)

    @property
    def pose(self) -> Pose:
        """Initial pose; the z axis of a plane's pose is its normal."""
        return self._pose(self.start or self)

    @property
    def offset(self) -> Pose:
        """Its pose in the TF frame that it follows."""
        return self._pose(self)

    def _pose(self, keys) -> Pose:
        n = sqrt(sum(c * c for c in keys.orientation))
        x, y, z, w = (c / n for c in keys.orientation)
        orientation = x, y, z, w
        if self.plane is not None:
            orientation = multiply(orientation, from_z_axis(self.plane.normal))
        return Pose(keys.position, orientation)


SHAPES = {'plane': PLANE, 'sphere': SPHERE, 'capsule': CAPSULE, 'cylinder': CYLINDER, 'box': BOX,
          'mesh': MESH, 'heights': HEIGHTS}


def shape_size(entry: Entry) -> tuple[float, float, float]:
    """Return the size of a shape as in ``Colliders.size`` [m]."""
    if entry.sphere is not None:
        return entry.sphere.radius, 0.0, 0.0
    if entry.box is not None:
        x, y, z = entry.box.size
        return 0.5 * x, 0.5 * y, 0.5 * z
    if entry.heights is not None:
        x, y = entry.heights.size
        return 0.5 * x, 0.5 * y, 0.0
    if entry.plane is not None or entry.mesh is not None:
        return 0.0, 0.0, 0.0
    tube = entry.capsule or entry.cylinder
    assert tube is not None
    return tube.radius, 0.5 * tube.length, 0.0


def shape_of(name: str, size: tuple[float, ...]):
    """Return a shape of the name and size of a ``PlaceCollider`` command."""
    if name == 'box':
        x, y, z = size
        return Box((x, y, z))
    if name == 'mesh':
        return Body(f'{len(size) // 9} triangles, {hash(size):x}')
    return Sphere(*size) if name == 'sphere' else Cylinder(*size)
