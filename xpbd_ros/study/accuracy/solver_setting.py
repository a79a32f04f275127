"""One setting of the solver, and the ladder of settings that a scene is tried with."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import log2

from xpbd_ros.errors import InputError
from xpbd_ros.scene.auto import cost
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation

METHODS = ('gauss_seidel', 'gauss_seidel_symmetric', 'line', 'jacobi', 'explicit')
BASELINES = ('pbd', 'textbook_xpbd', 'decayed_multiplier', 'mass_spring')
"""of studies only: no scene can ask for them"""
UNBOUND_MS = 1e9
"""a budget that bounds nothing"""
FEWEST, RUNGS = 2, 9
"""substeps of the lowest rung, and how many rungs a method has at most"""
FINEST = 16
"""substeps of the highest rung at most, times those that resolve the stretch"""
REPEATED = 4
"""iterations of the settings that repeat within a substep"""


@dataclass(frozen=True)
class Setting:
    """How constraints are solved."""

    method: str
    integrator: str
    substeps: int
    iterations: int = 1
    precision: str = 'float64'

    @property
    def key(self) -> str:
        """Its name, one for each setting."""
        name = f'{self.method} {self.integrator} {self.substeps}x{self.iterations}'
        return name if self.precision == 'float64' else f'{name} {self.precision}'

    @property
    def kind(self) -> tuple[str, str, str]:
        """What is one piece of machine code."""
        return self.method, self.integrator, self.precision

    @property
    def is_baseline(self) -> bool:
        """Whether only studies know it."""
        return self.method in BASELINES

    def block(self) -> dict:
        """Return it as the keys of a ``solver`` section."""
        return asdict(self)


@dataclass(frozen=True)
class Refused:
    """A setting, or all of a method, that the scene cannot be run with."""

    method: str
    reason: str


def setting_of(simulation: Simulation) -> Setting:
    """Return what a simulation runs with."""
    solver = simulation.solver
    return Setting(solver.method, solver.integrator, solver.substeps, solver.iterations,
                   solver.precision)


def with_solver(scene: Scene, keys: dict) -> Scene:
    """
    Return a scene with other keys in its ``solver`` section; None takes one out.

    Its ``error_target`` is left out: what a setting gives is what a study asks. So are its
    ``threads``: runs share the cores as they are, and times are those of one.
    """
    solver = {**(scene.raw.get('solver') or {}), 'error_target': None, 'threads': None, **keys}
    solver = {key: value for key, value in solver.items() if value is not None}
    return scene_from_mapping({**scene.raw, 'solver': solver}, where=scene.where, name=scene.name)


def default_solver(scene: Scene) -> Setting:
    """Return what ``auto`` takes for a scene where time is no object."""
    top = scene.top.solver
    free = with_solver(scene, {'method': 'auto', 'integrator': None, 'substeps': None,
                               'iterations': 1, 'precision': 'float64',
                               'budget_ms': max(top.budget_ms, 500.0 / scene.top.frame_rate)})
    return setting_of(compile_scene(free))


def ladder(scene: Scene, methods: Sequence[str] = METHODS, *, baselines: bool = False
           ) -> tuple[list[Setting], list[Refused]]:
    """
    Return the settings to try: each method with each integrator, substeps by powers of two.

    Beside them there are settings with one substep and many iterations, with some of both, and in
    single precision; and what the scene itself says.
    """
    found, refused = {}, []

    def add(setting: Setting) -> None:
        found.setdefault(setting.key, setting)

    scene_itself = setting_of(compile_scene(scene))
    usual = default_solver(scene)
    if scene_itself.method in methods:
        add(scene_itself)
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
    finest = with_substeps(usual, FINEST * usual.substeps)
    return [one for one in found.values() if one.key != finest.key], refused    # that is the truth


def baseline_ladder(rungs: Sequence[int]) -> list[Setting]:
    """Return the settings of what only studies know: as the papers that they are from use them."""
    return [*(Setting(method, 'backward_euler', 1, count)
              for method in ('pbd', 'textbook_xpbd') for count in rungs),
            *(Setting('decayed_multiplier', 'backward_euler', count) for count in rungs),
            *(Setting('mass_spring', 'symplectic_euler', count) for count in rungs)]


def rungs_of(simulation: Simulation, method: str, usual: Setting) -> list[int]:
    """Return powers of two up to what a whole frame pays for, by the table, or to FINEST."""
    most = 1e9 * simulation.frame_dt / cost(method, 1, simulation.effects, simulation.state)
    top = max(3, int(log2(max(min(most, FINEST * usual.substeps), 1.0))))
    low = max(int(log2(FEWEST)), top - RUNGS + 1)
    return [2**k for k in range(low, top + 1)]


def with_substeps(setting: Setting, substeps: int) -> Setting:
    """Return the same setting with another number of substeps."""
    return replace(setting, substeps=substeps)

