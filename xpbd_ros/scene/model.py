"""What a scene file says, as frozen values."""

from dataclasses import dataclass, fields
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.materials import Isotropic
from xpbd_ros.sim.parameters import check_static, quantity


@dataclass(frozen=True)
class SolverKeys:
    """The ``solver`` section, and a settings file."""

    method: str = quantity('auto', choices=('auto', 'gauss_seidel', 'gauss_seidel_symmetric',
                                            'line', 'jacobi', 'explicit'))
    integrator: str | None = quantity(None, choices=('backward_euler', 'bdf2', 'ndf2', 'leapfrog'),
                                      doc='what goes with the method unless given')
    substeps: int | None = quantity(None, minimum=1, maximum=10_000, live=True,
                                    doc='per frame; what auto chooses unless given')
    iterations: int = quantity(1, minimum=1, maximum=10_000, live=True, doc='per substep')
    precision: str = quantity('float64', choices=('float64', 'float32'))
    threads: int = quantity(1, minimum=1, maximum=64)
    budget_ms: float = quantity(8.0, unit='ms', above=0.0, doc='time that auto may use per frame')
    error_target: float | None = quantity(
        None, unit='m', above=0.0, doc='estimated error of a frame, RMS over the particles, that '
        'substeps are changed to hold')
    max_substeps: int = quantity(64, minimum=1, maximum=10_000,
                                 doc='the most that error_target may take')
    compliance_scale: float = quantity(1.0, above=0.0, live=True, doc='multiplies all compliances')


@dataclass(frozen=True)
class Grid:
    """A rectangle of particles."""

    size: tuple[float, float] = quantity(unit='m', above=0.0, doc='extent along warp, weft')
    resolution: tuple[int, int] = quantity(minimum=1, maximum=10_000,
                                           doc='particles along warp, weft')


@dataclass(frozen=True)
class MeshKeys:
    """A surface or body from a file."""

    file: str = quantity(doc='beside the scene file, or an absolute path')
    scale: float = quantity(1.0, above=0.0, doc="metres in the file's unit")
    warp: tuple[float, float, float] = quantity((1.0, 0.0, 0.0), doc='direction of the warp')

    def __post_init__(self):
        """Refuse a direction that is none."""
        if not any(self.warp):
            raise InputError('warp: must not be zero (a direction, such as [1, 0, 0])')


@dataclass(frozen=True)
class PoseKeys:
    """Where a cloth starts."""

    position: tuple[float, float, float] = quantity((0.0, 0.0, 0.0), unit='m')
    orientation: tuple[float, float, float, float] = quantity((0.0, 0.0, 0.0, 1.0),
                                                              doc='quaternion x y z w')


@dataclass(frozen=True)
class ClothKeys:
    """One entry of ``cloths``; its effects are parsed apart."""

    grid: Grid | None = quantity(None, doc='a rectangle')
    mesh: MeshKeys | None = quantity(None, doc='or a mesh from a file')
    density: float | None = quantity(None, unit='kg/m²', above=0.0,
                                     doc='kg/m³ for tetrahedra; by the material unless given')
    material: str | Isotropic | None = quantity(None, doc='a fabric by name, or a solid')
    pose: PoseKeys = quantity(PoseKeys())
    friction: float = quantity(0.5, minimum=0.0, live=True, doc='coefficient μ of its surface')
    static_friction: float | None = quantity(
        None, minimum=0.0, live=True, doc='coefficient while it sticks; friction unless given')

    def __post_init__(self):
        """Refuse what has no shape or two."""
        if (self.grid is None) == (self.mesh is None):
            raise InputError("needs either 'grid' or 'mesh', and only one of them")
        check_static(self.static_friction, self.friction)


@dataclass(frozen=True)
class TopKeys:
    """The plain keys of a scene."""

    gravity: tuple[float, float, float] = quantity((0.0, 0.0, -9.80665), unit='m/s²', live=True)
    frame_id: str = quantity('world')
    frame_rate: float = quantity(60.0, unit='Hz', minimum=1.0, maximum=10_000.0)
    duration: float = quantity(4.0, unit='s', above=0.0, doc='used by run and accuracy')
    solver: SolverKeys = quantity(SolverKeys())


@dataclass(frozen=True)
class Scene:
    """A scene that has passed every check."""

    name: str
    """its file's name without the suffix"""
    top: TopKeys
    cloths: dict[str, ClothKeys]
    cloth_effects: dict[str, dict[str, Any]]
    """parameters by cloth and effect"""
    effects: dict[str, Any]
    """parameters of the effects of the scene, by name"""
    sections: dict[str, dict[str, Any]]
    """``pins`` and ``colliders`` where the scene has them"""
    raw: dict
    """what the YAML said, overrides included"""
    where: str
    """the file, as the user named it"""

    @property
    def effect_names(self) -> tuple[str, ...]:
        """All effects that it calls for, in projection order."""
        from xpbd_ros.effects import EFFECTS
        used = set(self.effects).union(*self.cloth_effects.values())
        return tuple(name for name in EFFECTS if name in used)


def live_keys(scene: Scene) -> dict[str, tuple[Any, Any]]:
    """
    Return the keys that may change while the simulation runs.

    Returns
    -------
    dotted key: (its dataclass field, its present value)

    """
    found = {}

    def walk(prefix: str, values: Any) -> None:
        for field in fields(values):
            value = getattr(values, field.name)
            if field.metadata.get('live') and value is not None:
                found[f'{prefix}{field.name}'] = (field, value)

    walk('', scene.top)
    walk('solver.', scene.top.solver)
    for name, cloth in scene.cloths.items():
        walk(f'cloths.{name}.', cloth)
        for effect, parameters in scene.cloth_effects[name].items():
            walk(f'cloths.{name}.effects.{effect}.', parameters)
    for section, entries in scene.sections.items():
        for name, entry in entries.items():
            walk(f'{section}.{name}.', entry)
    for effect, parameters in scene.effects.items():
        walk(f'effects.{effect}.', parameters)
    return found


def with_key(raw: dict, key: str, value: Any) -> dict:
    """Return a copy of a scene's mapping with one dotted key set."""
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
