"""Predict the stiffness that a solver setting really gives."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.sim.stepping.methods import is_swept_once
from xpbd_ros.sim.stepping.solver import Solver
from xpbd_ros.study.prediction.loads import (
    hanging_tensions,
    hung_side,
    inflated_tensions,
    Sheet,
    sheets,
)
from xpbd_ros.study.prediction.static_response import (
    BACKWARD,
    FORWARD,
    JACOBI,
    LINES,
    ONCE,
    PATHS,
    StaticResponse,
)

WARP, WEFT = 0, 1
SIGNIFICANT = 0.01
"""least tension of the constraints that are evaluated, over the largest tension"""
STEP_RATIO = {'backward_euler': 1.0, 'leapfrog': 1.0, 'bdf2': 2.0 / 3.0, 'ndf2': 0.6}
"""effective step H of an integrator over the substep"""
IN_PLANE = ('cross_bend', 'area', 'pressure', 'shear', 'membrane', 'stretch')
"""effects that act within a surface, in projection order"""
UNPREDICTED = {'volume': 'its constraints have no direction at rest, and the prediction is one '
                         'for small displacements',
               'cross_bend': 'flat hinges yield to small folds with any number of substeps'}
"""effects whose stiffness is not predicted, with the reason"""
LEAST_PRESSURE = 1e-6
"""smallest overpressure that is reported [Pa]"""
GRAVITY = 9.80665
"""load of hanging cloth [m/s²]; any value gives the same stiffness, as the response is linear"""


@dataclass(frozen=True)
class Row:
    """Asked and effective stiffness of one effect of a cloth."""

    cloth: str
    effect: str
    direction: str | None
    """'warp', 'weft' or None"""
    unit: str
    asked: float
    """stiffness in the scene; inf if rigid"""
    effective: float
    """stiffness of the cloth as a whole"""
    effective_min: float
    """smallest stiffness of a constraint"""
    effective_max: float
    """largest stiffness of a constraint"""

    @property
    def error(self) -> float:
        """Relative error of the strain, asked / effective - 1; inf for rigid constraints."""
        if np.isinf(self.effective):
            return 0.0 if np.isinf(self.asked) else -1.0
        return self.asked / self.effective - 1.0


def step_length(solver: Solver, frame_dt: float) -> float:
    """Return the effective step H of a substep [s], for a particle with a full history."""
    return frame_dt / solver.substeps * STEP_RATIO[solver.integrator]


def response_of(sheet: Sheet, names: list[str], solver: Solver, frame_dt: float, *,
                held: np.ndarray | tuple[int, ...] = (), damping: float = 0.0) -> StaticResponse:
    """
    Return the static response of effects of a sheet.

    Parameters
    ----------
    sheet : the cloth
    names : effects, in projection order
    solver : setting
    frame_dt : frame period [s]
    held : indices of particles that do not move
    damping : damping rate [1/s], which reduces the mobilities

    """
    H = step_length(solver, frame_dt)
    mobility = sheet.inv_mass * H * H / (1.0 + damping * H)
    mobility[np.asarray(held, int)] = 0.0
    parts = [sheet.effects[name] for name in names]
    sizes = np.cumsum([0, *(part.jacobian.shape[0] for part in parts)])
    rows = {name: np.arange(a, b) for name, a, b in zip(names, sizes[:-1], sizes[1:])}
    everything = np.arange(sizes[-1])
    if solver.method == 'line':
        passes = _passes_of_lines(sheet, rows, frame_dt / solver.substeps,
                                  alternate=solver.substeps > 1)
    elif solver.method == 'gauss_seidel_symmetric':
        passes = [(FORWARD, everything), (BACKWARD, everything)]
    elif solver.method == 'jacobi':
        passes = [(JACOBI, everything)]
    elif solver.method == 'explicit':
        passes = []
    else:
        passes = [(FORWARD, everything)]
    return StaticResponse(
        sparse.vstack([part.jacobian for part in parts]).tocsr(),
        sparse.block_diag([part.compliance for part in parts]).tocsr(), mobility, tuple(passes),
        solver.iterations, 1.0 / sheet.most_constraints,
        np.concatenate([a + np.arange(b - a) // part.blocks.shape[1]
                        for part, a, b in zip(parts, sizes[:-1], sizes[1:])]))


def _passes_of_lines(sheet: Sheet, rows: dict[str, np.ndarray], h: float, *,
                     alternate: bool) -> list[tuple]:
    """
    Return the passes of ``line`` over the rows of each effect, in substeps of h [s].

    Soft effects are swept once where substeps ``alternate``, here always forward: backward yields
    the same stiffness.
    """
    edges, lines = np.zeros(0, int), []
    if 'stretch' in rows and (sheet.is_grid or sheet.packs is not None):
        edges, along = rows.pop('stretch'), sheet.effects['stretch'].along
        lines = ([(LINES, edges[along == WARP]), (LINES, edges[along == WEFT])]
                 if sheet.packs is None else
                 [(PATHS, edges[sheet.packs == k]) for k in np.unique(sheet.packs)])
    soft = [name for name in rows if alternate and is_swept_once(sheet.effects[name].rate, h)]
    stiff = [name for name in rows if name not in soft]
    return [*((FORWARD, rows[name]) for name in stiff), *lines,
            *((ONCE, rows[name]) for name in soft), *lines,
            *((BACKWARD, rows[name]) for name in reversed(stiff)), (FORWARD, edges)]


def stiffness(scene: Scene, simulation: Simulation, solver: Solver) -> list[Row]:
    """Return a row for each modulus of each cloth with a solver setting."""
    rate = scene.effects['damping'].rate if 'damping' in scene.effects else 0.0
    return [row for sheet in sheets(simulation)
            for row in _LoadedSheet(sheet, scene.cloth_effects[sheet.name],
                                    scene.top.solver.compliance_scale, solver,
                                    simulation.frame_dt, rate).rows()]


@dataclass(frozen=True)
class _LoadedSheet:
    """One sheet with a solver setting, under the loads of ``loads``."""

    sheet: Sheet
    asked: dict
    """parameters of the effects in the scene"""
    scale: float
    """``solver.compliance_scale``"""
    solver: Solver
    frame_dt: float
    """frame period [s]"""
    rate: float
    """damping rate [1/s]"""

    def rows(self) -> list[Row]:
        """Return a row for each modulus."""
        sheet, parts = self.sheet, self.sheet.effects
        plane, found = [name for name in IN_PLANE if name in parts], []
        if 'bend' in parts:
            found += self.bent()
        if 'hinge' in parts:
            found += self.displaced('hinge', 'N m', np.ones(len(parts['hinge'].blocks)), ['hinge'])
        if 'area' in parts:    # α is the rest area over the stiffness
            found += self.displaced('area', 'N/m', parts['area'].blocks.ravel(), plane)
        if 'shear' in parts:
            sheared = np.zeros(3 * len(sheet.rest))
            sheared[0::3] = sheet.rest[:, 1]
            found += self.displaced('shear', 'N/m', parts['shear'].jacobian @ sheared, plane)
        inflatable = 'pressure' in parts and len(plane) > 1
        return found + (self.inflated(plane) if inflatable else self.hanging(plane))

    def response(self, names: list[str], held=()) -> StaticResponse:
        """Return the static response of effects."""
        return response_of(self.sheet, names, self.solver, self.frame_dt, held=held,
                           damping=self.rate)

    def rows_of(self, names: list[str], name: str) -> np.ndarray:
        """Return the indices of an effect's rows in the response of effects."""
        sizes = {n: self.sheet.effects[n].jacobian.shape[0] for n in names}
        first = sum(sizes[n] for n in names[:names.index(name)])
        return first + np.arange(sizes[name])

    def bent(self) -> list[Row]:
        """
        Return the rows of ``bend`` under uniform curvature, one each for two rigidities.

        A single rigidity is that along warp, or along weft where rows are too short to bend.
        """
        asked, found = self.asked['bend'], []
        for axis, direction in ((WARP, 'warp'), (WEFT, 'weft')):
            curved = np.zeros(3 * len(self.sheet.rest))
            curved[2::3] = 0.5 * self.sheet.rest[:, axis]**2
            found += self.displaced('bend', 'N m', self.sheet.effects['bend'].jacobian @ curved,
                                    ['bend'], None if asked.stiffness else direction)
        return found[:1] if asked.stiffness else found

    def displaced(self, name: str, unit: str, residual: np.ndarray, names: list[str],
                  direction: str | None = None) -> list[Row]:
        """
        Return the row of an effect with given residuals, while others have no tension.

        Empty if the residuals are 0.
        """
        response, rows = self.response(names), self.rows_of(names, name)
        tension = np.zeros(response.coupling.shape[0])
        tension[rows] = self.sheet.effects[name].stiffness @ residual
        if not tension.any():
            return []
        asked = self.asked[name]
        modulus = asked.stiffness or getattr(asked, direction or 'warp')
        return [self.row(name, direction, unit, modulus, response, tension, rows)]

    def directions(self, names: list[str]):
        """Yield effect, direction, axis, modulus and rows for warp and weft."""
        for name in ('membrane', 'stretch'):
            if name not in names:
                continue
            rows, along = self.rows_of(names, name), self.sheet.effects[name].along
            for axis, direction in ((WARP, 'warp'), (WEFT, 'weft')):
                if name == 'membrane':
                    yield name, direction, axis, self.asked[name].moduli[axis], rows[axis::3]
                elif (along == axis).any():
                    modulus = getattr(self.asked[name], direction)
                    if modulus is None:    # the scene gives a compliance
                        alpha = self.asked[name].compliance
                        modulus = 1.0 / alpha if alpha else np.inf
                    yield name, direction, axis, modulus, rows[along == axis]

    def hanging(self, names: list[str]) -> list[Row]:
        """Return the rows of a sheet that hangs along warp and along weft."""
        found, loads = [], {}
        for name, direction, axis, modulus, rows in self.directions(names):
            if axis not in loads:
                loads[axis] = (self.response(names, hung_side(self.sheet, axis)),
                               hanging_tensions(self.sheet, axis, GRAVITY, names))
            found.append(self.row(name, direction, 'N/m', modulus, *loads[axis], rows))
        return found

    def inflated(self, names: list[str]) -> list[Row]:
        """
        Return the rows of an inflated surface, and that of its overpressure.

        With the tensions T and the residuals C of surface and gas under 1 Pa, T·C is, by virtual
        work, the volume gained per 1 Pa, so that the overpressure is (V* - V) / T·C.
        """
        response, tension = self.response(names), inflated_tensions(self.sheet, names)
        found = [self.row(name, direction, 'N/m', modulus, response, tension, rows)
                 for name, direction, _, modulus, rows in self.directions(names)]
        wanted = self.sheet.excess / (tension @ (response.compliance @ tension))
        given = tension @ response.residuals(tension)
        if abs(wanted) > LEAST_PRESSURE:
            left = self.sheet.excess / given if given > 0.0 else np.inf
            found.append(Row(self.sheet.name, 'pressure', None, 'Pa', float(wanted),
                             *[float(left)] * 3))
        return found

    def row(self, name: str, direction: str | None, unit: str, modulus: float,
            response: StaticResponse, tension: np.ndarray, rows: np.ndarray) -> Row:
        """Return the stiffness that rows of a response have under tensions [N]."""
        return _row(self.sheet.name, name, direction, unit, modulus / self.scale, response,
                    tension, rows)


def _row(cloth: str, effect: str, direction: str | None, unit: str, asked: float,
         response: StaticResponse, tension: np.ndarray, rows: np.ndarray) -> Row:
    given = response.residuals(tension)[rows]
    wanted, tension = (response.compliance @ tension)[rows], tension[rows]
    evaluated = np.abs(tension) >= SIGNIFICANT * np.abs(tension).max()
    sign, given, wanted, tension = (
        a[evaluated] for a in (np.sign(tension), given, wanted, tension))
    with np.errstate(divide='ignore'):
        if np.isinf(asked):
            mean, each = np.abs(tension).sum() / (sign * given).sum(), tension / given
        else:
            mean = asked * (sign * wanted).sum() / (sign * given).sum()
            each = asked * wanted / given
    each = np.where(sign * given > 0.0, each, np.inf)
    mean = mean if mean > 0.0 else np.inf    # rigid up to rounding errors
    least, most = each.min(), each.max()
    return Row(cloth, effect, direction, unit, float(asked), float(np.clip(mean, least, most)),
               float(least), float(most))
