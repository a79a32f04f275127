"""Solver settings, and the ladder of settings that a study tries."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from math import log2

from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import MAX_SUBSTEPS, ROUGH
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.cost_table import SHIPPED
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.methods import METHODS

BASELINES = ('pbd', 'textbook_xpbd', 'decayed_multiplier', 'mass_spring')
"""methods that exist in studies only"""
UNBOUND_MS = 1e9
"""a budget without effect [ms]"""
FEWEST, RUNGS = 2, 9
"""substeps of the lowest rung, and largest number of rungs of a method"""
FINEST = 16
"""largest number of substeps over those that resolve the stretch"""
REPEATED = 4
"""iterations of the settings with several substeps and iterations"""
AUTO = {'method': 'auto', 'integrator': None, 'substeps': None, 'iterations': 1,
        'precision': 'float64'}
"""keys of the default"""
BUDGETS = 2.0, 4.0, 8.0
"""with which the default is compared with the other settings [ms]"""


@dataclass(frozen=True)
class Setting:
    """A solver setting."""

    method: str
    integrator: str
    substeps: int
    iterations: int = 1
    precision: str = 'float64'
    rough_frames: int | None = None
    """of a mix with ``line``, as the next two"""
    rough_integrator: str | None = None
    rough_substeps: int | None = None

    @property
    def key(self) -> str:
        """Unique name of the setting."""
        name = f'{self.method} {self.integrator} {self.substeps}x{self.iterations}'
        if self.rough_frames:
            name += f' and line {self.rough_integrator} {self.rough_substeps}x1'
        return name if self.precision == 'float64' else f'{name} {self.precision}'

    @property
    def kind(self) -> tuple[str, str, str]:
        """Method, integrator and precision: settings that share compiled kernels."""
        return self.method, self.integrator, self.precision

    @property
    def is_baseline(self) -> bool:
        """True if it is one of BASELINES."""
        return self.method in BASELINES

    def block(self) -> dict:
        """Return the keys of a ``solver`` section."""
        return {key: value for key, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class Refused:
    """A method, or a method with an integrator, that cannot run the scene."""

    method: str
    reason: str


def setting_of(simulation: Simulation) -> Setting:
    """Return the setting of a simulation."""
    solver = simulation.solver
    rough = () if not solver.mixes else (solver.rough_frames, solver.rough_integrator,
                                         solver.rough_substeps)
    return Setting(solver.method, solver.integrator, solver.substeps, solver.iterations,
                   solver.precision, *rough)


def with_solver(scene: Scene, keys: dict) -> Scene:
    """
    Return a scene with changed keys in its ``solver`` section; None removes a key.

    ``error_target`` is removed, as a study measures fixed settings, and so are the keys of rough
    frames, and ``threads``, as runs are timed on one core.
    """
    solver = {**(scene.raw.get('solver') or {}), 'error_target': None, 'threads': None,
              **dict.fromkeys(ROUGH), **keys}
    solver = {key: value for key, value in solver.items() if value is not None}
    return scene_from_mapping({**scene.raw, 'solver': solver}, where=scene.where, name=scene.name)


def default_solver(scene: Scene) -> Setting:
    """
    Return the setting that ``auto`` chooses with a budget of at least half a frame period.

    Of a mix, that of rough frames.
    """
    top = scene.top.solver
    simulation = compile_scene(with_solver(scene, {
        **AUTO, 'budget_ms': max(top.budget_ms, 500.0 / scene.top.frame_rate)}))
    if not simulation.solver.mixes:
        return setting_of(simulation)
    rough = simulation.solver.rough
    return Setting(rough.method, rough.integrator, rough.substeps, rough.iterations)


def auto_settings(scene: Scene) -> dict[float, Setting]:
    """Return the settings that ``auto`` chooses, by BUDGETS [ms]."""
    return {budget: setting_of(compile_scene(with_solver(scene, {**AUTO, 'budget_ms': budget})))
            for budget in BUDGETS}


def ladder(scene: Scene, methods: Collection[str] = METHODS, *, baselines: bool = False
           ) -> tuple[list[Setting], list[Refused]]:
    """
    Return the settings to try, and those that cannot run the scene.

    Each method runs with each integrator, with powers of two as substeps. There are also settings
    with one substep and many iterations, with several of both, in single precision, those of
    ``auto``, and that of the scene itself.
    """
    found: dict[str, Setting] = {}
    refused = []

    def add(setting: Setting) -> None:
        found.setdefault(setting.key, setting)

    scene_itself = setting_of(compile_scene(scene))
    usual = default_solver(scene)
    add(scene_itself)
    for setting in auto_settings(scene).values():
        if setting.method in methods:
            add(setting)
    for method in methods:
        integrators = (('leapfrog',) if method == 'explicit' else
                       ('backward_euler', 'bdf2', 'ndf2'))
        try:
            keys = {'method': method, 'integrator': integrators[0], 'iterations': 1,
                    'substeps': None, 'precision': 'float64', 'budget_ms': UNBOUND_MS}
            simulation = compile_scene(with_solver(scene, keys))
        except InputError as error:
            refused.append(Refused(method, str(error).removeprefix(f'{scene.where}: ')))
            continue
        if method == 'explicit':
            for factor in (1, 2, 4):
                if factor * simulation.solver.substeps <= MAX_SUBSTEPS:
                    add(Setting(method, 'leapfrog', factor * simulation.solver.substeps))
            add(Setting(method, 'leapfrog', simulation.solver.substeps, precision='float32'))
            continue
        rungs = rungs_of(simulation, method, usual)
        barred = {one: name for name, built in simulation.effects.items()
                  for one in built.incompatible_with}
        for integrator in integrators:
            if integrator in barred:
                refused.append(Refused(f'{method} {integrator}',
                                       f'is unstable with {barred[integrator]}'))
                continue
            for substeps in rungs:
                add(Setting(method, integrator, substeps))
        if method == 'gauss_seidel':
            for iterations in rungs[1::2]:
                add(Setting(method, 'backward_euler', 1, iterations))
        if method == usual.method:
            for substeps in rungs[:-2]:
                add(Setting(method, usual.integrator, substeps, REPEATED))
            for substeps in rungs:
                add(Setting(method, usual.integrator, substeps, precision='float32'))
    if baselines:
        simulation = compile_scene(with_solver(scene, {**usual.block(), 'method': 'gauss_seidel',
                                                       'integrator': 'backward_euler'}))
        for setting in baseline_ladder(rungs_of(simulation, 'gauss_seidel', usual)):
            add(setting)
    finest = with_substeps(usual, min(FINEST * usual.substeps, MAX_SUBSTEPS))
    return [one for one in found.values() if one.key != finest.key], refused    # true solution


def baseline_ladder(rungs: Sequence[int]) -> list[Setting]:
    """Return the settings of the baselines, as their papers use them."""
    return [*(Setting(method, 'backward_euler', 1, count)
              for method in ('pbd', 'textbook_xpbd') for count in rungs),
            *(Setting('decayed_multiplier', 'backward_euler', count) for count in rungs),
            *(Setting('mass_spring', 'symplectic_euler', count) for count in rungs)]


def rungs_of(simulation: Simulation, method: str, usual: Setting) -> list[int]:
    """Return powers of two up to FINEST, or to the substeps that fit into a frame period."""
    most = 1e9 * simulation.frame_dt / SHIPPED.substep_ns(method, 1, simulation.effects,
                                                          simulation.state)
    top = max(3, int(log2(max(min(most, FINEST * usual.substeps, MAX_SUBSTEPS), 1.0))))
    low = max(int(log2(FEWEST)), top - RUNGS + 1)
    return [2**k for k in range(low, top + 1)]


def with_substeps(setting: Setting, substeps: int) -> Setting:
    """Return the same setting with another number of substeps."""
    return replace(setting, substeps=substeps)

