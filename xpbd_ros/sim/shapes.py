"""What a scene says of a collider: its shape, its place and its surface."""

from dataclasses import dataclass
from math import sqrt

from xpbd_ros.errors import InputError
from xpbd_ros.sim.colliders import BOX, CAPSULE, CYLINDER, PLANE, SPHERE
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.effect import check_static, quantity
from xpbd_ros.sim.motion import check_motion
from xpbd_ros.sim.rotation import from_z_axis, multiply


@dataclass(frozen=True)
class Plane:
    """The half space below a plane."""

    normal: tuple[float, float, float] = quantity((0.0, 0.0, 1.0), doc='pointing out of it')

    def __post_init__(self):
        """Refuse a direction that is none."""
        if not any(self.normal):
            raise InputError('normal: must not be zero')


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    radius: float = quantity(unit='m', above=0.0)


@dataclass(frozen=True)
class Capsule:
    """A ball swept along z."""

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
class Entry:
    """One entry of the scene's ``colliders``: exactly one shape, and where it is."""

    plane: Plane | None = quantity(None)
    sphere: Sphere | None = quantity(None)
    capsule: Capsule | None = quantity(None)
    cylinder: Cylinder | None = quantity(None)
    box: Box | None = quantity(None)
    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m')
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')
    friction: float = quantity(0.5, minimum=0.0, live=True, doc='coefficient μ')
    static_friction: float | None = quantity(
        None, minimum=0.0, live=True, doc='coefficient while it sticks; friction unless given')
    restitution: float = quantity(0.0, minimum=0.0, maximum=1.0,
                                  doc='speed after a bounce / speed before')
    motion: tuple[tuple[float, ...], ...] | None = quantity(
        None, unit='s, m', doc='points t, x, y, z, joined by monotone cubics')
    max_speed: float = quantity(5.0, unit='m/s', above=0.0, doc='it follows no faster')

    def __post_init__(self):
        """Refuse no shape and two shapes."""
        given = [name for name in SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(f'needs exactly one shape of {", ".join(SHAPES)} '
                             f'(got {", ".join(given) or "none"})')
        check_static(self.static_friction, self.friction)
        check_motion(self.motion)

    @property
    def shape(self) -> str:
        """The name of its shape."""
        return next(name for name in SHAPES if getattr(self, name) is not None)

    @property
    def pose(self) -> Pose:
        """Where it is at the start; a plane's normal is its z axis."""
        n = sqrt(sum(c * c for c in self.orientation))
        orientation = tuple(c / n for c in self.orientation)
        if self.plane is not None:
            orientation = multiply(orientation, from_z_axis(self.plane.normal))
        return Pose(self.position, orientation)


SHAPES = {'plane': PLANE, 'sphere': SPHERE, 'capsule': CAPSULE, 'cylinder': CYLINDER, 'box': BOX}


def shape_size(entry: Entry) -> tuple[float, float, float]:
    """Return the numbers that the kernels want of a shape."""
    if entry.sphere is not None:
        return entry.sphere.radius, 0.0, 0.0
    if entry.box is not None:
        return tuple(0.5 * c for c in entry.box.size)
    if entry.plane is not None:
        return 0.0, 0.0, 0.0
    tube = entry.capsule or entry.cylinder
    return tube.radius, 0.5 * tube.length, 0.0


def shape_of(name: str, size: tuple[float, ...]):
    """Return a box, a sphere or a cylinder of a size: extents; radius; radius and length."""
    if name == 'box':
        return Box(size)
    return Sphere(*size) if name == 'sphere' else Cylinder(*size)
