"""A scene file as frozen dataclasses."""

from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.materials import Isotropic
from xpbd_ros.sim.parameters import check_frame_name, check_static, quantity

MOST_THREADS = 64
"""threads of a simulation, at most"""
MOST_PARTICLES = 4_000_000
"""of a grid"""


@dataclass(frozen=True)
class SolverKeys:
    """The ``solver`` section, and a settings file."""

    method: str = quantity('auto', choices=('auto', 'gauss_seidel', 'gauss_seidel_symmetric',
                                            'line', 'jacobi', 'explicit'),
                           doc='auto: line, or explicit in calm frames and line in others')
    integrator: str | None = quantity(None, choices=('backward_euler', 'bdf2', 'ndf2', 'leapfrog'),
                                      doc="chosen by auto, or the method's default, unless given")
    substeps: int | None = quantity(None, minimum=1, maximum=10_000, live=True,
                                    doc='per frame; chosen by auto unless given')
    iterations: int = quantity(1, minimum=1, maximum=10_000, live=True, doc='per substep')
    precision: str = quantity('float64', choices=('float64', 'float32'),
                              doc='of the arithmetic')
    order: str = quantity('sequential', choices=('sequential', 'coloured'),
                          doc='of the constraints in a sweep: neighbours one after another, or '
                          'batches without a common particle')
    device: str = quantity('cpu', choices=('cpu', 'cuda'),
                           doc='cuda: an NVIDIA card (doc/gpu.md)')
    threads: int = quantity(1, minimum=0, maximum=MOST_THREADS,
                            doc='0: as many as pay on this machine')
    budget_ms: float = quantity(8.0, unit='ms', above=0.0, doc='time that auto may use per frame')
    cost_table: str | None = quantity(
        None, doc='file of xpbd_ros cost --calibrate, for budget_ms; the shipped table unless '
        'given')
    error_target: float | None = quantity(
        None, unit='m', above=0.0, doc='error of a frame (estimated, RMS over the particles) to '
        'hold by changing substeps')
    max_substeps: int = quantity(64, minimum=1, maximum=10_000,
                                 doc='largest number of substeps for error_target')
    compliance_scale: float = quantity(1.0, above=0.0, live=True, doc='multiplies all compliances')
    rough_frames: int | None = quantity(
        None, minimum=0, maximum=10_000, doc='calm frames of line after an unstable one of '
        'explicit; chosen by auto, else 0')
    rough_integrator: str | None = quantity(
        None, choices=('backward_euler', 'bdf2', 'ndf2'), doc='of these frames')
    rough_substeps: int | None = quantity(None, minimum=1, maximum=10_000,
                                          doc='of these frames; chosen unless given')


@dataclass(frozen=True)
class Grid:
    """A rectangle of particles."""

    size: tuple[float, float] = quantity(unit='m', above=0.0, doc='extent along warp, weft')
    resolution: tuple[int, int] = quantity(minimum=1, maximum=10_000,
                                           doc='particles along warp, weft')

    def __post_init__(self):
        """Refuse what fits into no memory: a million particles take 1.5 GB."""
        warp, weft = self.resolution
        if warp * weft > MOST_PARTICLES:
            raise InputError(f'resolution: must be at most {MOST_PARTICLES} particles in all '
                             f'(got {warp} × {weft} = {warp * weft})')


@dataclass(frozen=True)
class MeshKeys:
    """The key ``mesh`` of a cloth: a surface or body from a file."""

    file: str = quantity(doc='beside the scene file, or an absolute path')
    scale: float = quantity(1.0, above=0.0, doc="metres in the file's unit")
    warp: tuple[float, float, float] = quantity((1.0, 0.0, 0.0), doc='direction of the warp')

    def __post_init__(self):
        """Refuse a zero direction."""
        if not any(self.warp):
            raise InputError('warp: must not be zero (a direction, such as [1, 0, 0])')


@dataclass(frozen=True)
class PoseKeys:
    """The key ``pose`` of a cloth: its initial pose."""

    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m',
                                                    doc="of the grid's or the file's origin")
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')


@dataclass(frozen=True)
class ClothKeys:
    """One entry of ``cloths``, without its effects."""

    grid: Grid | None = quantity(None, doc='a rectangle')
    mesh: MeshKeys | None = quantity(None, doc='or a mesh from a file')
    density: float | None = quantity(None, unit='kg/m²', above=0.0,
                                     doc="kg/m³ for tetrahedra; the material's unless given")
    material: str | Isotropic | None = quantity(None, doc='a fabric by name, or a solid')
    pose: PoseKeys = quantity(PoseKeys())
    friction: float = quantity(0.5, minimum=0.0, live=True, doc='coefficient μ of its surface')
    static_friction: float | None = quantity(
        None, minimum=0.0, live=True, doc='coefficient while it sticks; friction unless given')

    def __post_init__(self):
        """Refuse a cloth without a shape or with two."""
        if (self.grid is None) == (self.mesh is None):
            raise InputError("needs either 'grid' or 'mesh', and only one of them")
        check_static(self.static_friction, self.friction)


@dataclass(frozen=True)
class TopKeys:
    """The top-level keys of a scene, without its sections."""

    gravity: tuple[float, float, float] = quantity((0.0, 0.0, -9.80665), unit='m/s²', live=True,
                                                   doc='acceleration of all particles')
    frame_id: str = quantity('world', doc='TF frame of all positions')
    frame_rate: float = quantity(60.0, unit='Hz', minimum=1.0, maximum=10_000.0,
                                 doc='frames per second of simulated time')
    duration: float = quantity(4.0, unit='s', above=0.0, doc='used by run and accuracy')
    solver: SolverKeys = quantity(SolverKeys())

    def __post_init__(self):
        check_frame_name('frame_id', self.frame_id)


@dataclass(frozen=True)
class Scene:
    """A scene that has passed every check."""

    name: str
    """name of its file without the suffix"""
    top: TopKeys
    cloths: dict[str, ClothKeys]
    cloth_effects: dict[str, dict[str, Any]]
    """parameters of cloth effects, by cloth and effect"""
    effects: dict[str, Any]
    """parameters of scene effects, by effect"""
    sections: dict[str, dict[str, Any]]
    """entries of ``pins``, ``colliders`` and ``seams``, by section and name"""
    raw: dict
    """mapping of the YAML file, overrides included"""
    where: str
    """path of the file as the user gave it, for error messages"""
    robots: dict[str, Any] = dataclasses.field(default_factory=dict)
    """robots by name (``scene.robots.Robot``), whose colliders are in ``sections``"""
    inputs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """topics of other programs with what they move, each a tuple of ``scene.inputs.Input``"""

    @property
    def effect_names(self) -> tuple[str, ...]:
        """All effects that the scene names, in projection order."""
        from xpbd_ros.effects import EFFECTS
        used = set(self.effects).union(*self.cloth_effects.values())
        return tuple(name for name in EFFECTS if name in used)


def live_keys(scene: Scene) -> dict[str, tuple[Any, Any]]:
    """Return (dataclass field, present value) of the live keys, by dotted key."""
    return {key: (field, value) for key, (field, value) in all_keys(scene).items()
            if field.metadata.get('live') and value is not None}


def all_keys(scene: Scene) -> dict[str, tuple[Any, Any]]:
    """Return (dataclass field, present value) of the keys of what a scene has, by dotted key."""
    found = dict(_fields('', scene.top))
    for name, cloth in scene.cloths.items():
        found.update(_fields(f'cloths.{name}.', cloth))
        for effect, parameters in scene.cloth_effects[name].items():
            found.update(_fields(f'cloths.{name}.effects.{effect}.', parameters))
    for section, entries in scene.sections.items():
        for name, entry in entries.items():
            found.update(_fields(f'{section}.{name}.', entry))
    for effect, parameters in scene.effects.items():
        found.update(_fields(f'effects.{effect}.', parameters))
    return found


def _fields(prefix: str, values: Any) -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Yield dotted keys and (field, value) of a dataclass and of those in it."""
    for field in fields(values):
        value = getattr(values, field.name)
        if is_dataclass(value):
            yield from _fields(f'{prefix}{field.name}.', value)
        else:
            yield f'{prefix}{field.name}', (field, value)


def with_key(raw: dict, key: str, value: Any) -> dict:
    """Return a copy of a scene's mapping with a dotted key set to a value."""
    changed = dict(raw)
    head, _, rest = key.partition('.')
    if not head:
        raise InputError(f"'{key}' is not a key")
    if rest:
        inner = changed.get(head)
        if inner is not None and not isinstance(inner, dict):
            raise InputError(f"'{head}' holds a value, so it has no key '{rest}'")
        changed[head] = with_key(inner or {}, rest, value)
    else:
        changed[head] = value
    return changed
