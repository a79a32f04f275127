"""The stiffness that a setting really gives, predicted before anything runs."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation, Solver
from xpbd_ros.study.prediction.law import APART, BACK, FORTH, Law, WHOLE
from xpbd_ros.study.prediction.loads import blown_up, hanging, hung_side, Sheet, sheets

WARP, WEFT = 0, 1
SEEN = 0.01
"""constraints under less than this part of the largest tension say nothing about stiffness"""
SHARE = {'backward_euler': 1.0, 'leapfrog': 1.0, 'bdf2': 2.0 / 3.0, 'ndf2': 0.6}
"""H of an integrator, in substeps"""
PLANE = ('cross_bend', 'area', 'pressure', 'shear', 'membrane', 'stretch')
"""what acts within a surface, in projection order"""
UNPREDICTED = {'volume': 'its constraints have no direction at rest, and the law is one for small '
                         'displacements',
               'cross_bend': 'flat hinges give way to small folds, whatever the substeps'}
"""effects with a stiffness of which nothing is said, and why"""
LEAST = 1e-6
"""overpressure of which nothing is said [Pa]"""
EARTH = 9.80665
"""[m/s²]; any would do, the law is linear"""


@dataclass(frozen=True)
class Row:
    """What one effect of a cloth was asked for and what it gives."""

    cloth: str
    effect: str
    direction: str | None
    unit: str
    asked: float
    """inf: rigid"""
    effective: float
    """mean over the constraints: what the whole gives"""
    effective_min: float
    effective_max: float

    @property
    def error(self) -> float:
        """How much more it gives than it was asked to, relative; inf where it should be rigid."""
        return 0.0 if np.isinf(self.effective) else self.asked / self.effective - 1.0


def step_length(solver: Solver, frame_dt: float) -> float:
    """Return H of a substep [s] for a particle that goes on undisturbed."""
    return frame_dt / solver.substeps * SHARE[solver.integrator]


def law_of(sheet: Sheet, names: list[str], solver: Solver, frame_dt: float, *,
           held: np.ndarray = (), damping: float = 0.0) -> Law:
    """
    Return the law for some effects of a sheet.

    Parameters
    ----------
    names : effects, in projection order
    held : particles that do not move
    damping : rate [1/s]; takes from the mobilities

    """
    H = step_length(solver, frame_dt)
    mobility = sheet.inv_mass * H * H / (1.0 + damping * H)
    mobility[np.asarray(held, int)] = 0.0
    parts = [sheet.effects[name] for name in names]
    sizes = np.cumsum([0, *(part.jacobian.shape[0] for part in parts)])
    rows = {name: np.arange(a, b) for name, a, b in zip(names, sizes[:-1], sizes[1:])}
    everything = np.arange(sizes[-1])
    if solver.method == 'line' and sheet.is_grid:
        others = np.concatenate([rows[name] for name in names if name != 'stretch']
                                or [np.zeros(0, int)])
        passes = [(FORTH, others)]
        if 'stretch' in rows:
            edges, along = rows['stretch'], sheet.effects['stretch'].along
            lines = [(WHOLE, edges[along == WARP]), (WHOLE, edges[along == WEFT])]
            passes += [*lines, *lines, (BACK, others), (FORTH, edges)]
        else:
            passes.append((BACK, others))
    elif solver.method in ('line', 'gauss_seidel_symmetric'):
        passes = [(FORTH, everything), (BACK, everything)]
    elif solver.method == 'jacobi':
        passes = [(APART, everything)]
    elif solver.method == 'explicit':
        passes = []
    else:
        passes = [(FORTH, everything)]
    return Law(sparse.vstack([part.jacobian for part in parts]).tocsr(),
               sparse.block_diag([part.compliance for part in parts]).tocsr(), mobility,
               tuple(passes), solver.iterations, 1.0 / sheet.crowd,
               np.concatenate([a + np.arange(b - a) // part.blocks.shape[1]
                               for part, a, b in zip(parts, sizes[:-1], sizes[1:])]))


def stiffness(scene: Scene, simulation: Simulation, solver: Solver) -> list[Row]:
    """Return a row for each modulus of each cloth at some setting."""
    rate = scene.effects['damping'].rate if 'damping' in scene.effects else 0.0
    return [row for sheet in sheets(simulation)
            for row in _Bench(sheet, scene.cloth_effects[sheet.name],
                              scene.top.solver.compliance_scale, solver, simulation.frame_dt,
                              rate).rows()]


@dataclass(frozen=True)
class _Bench:
    """One sheet at a setting, to be loaded."""

    sheet: Sheet
    asked: dict
    """what the scene says of its effects"""
    scale: float
    solver: Solver
    frame_dt: float
    rate: float
    """of the damping [1/s]"""

    def rows(self) -> list[Row]:
        """Return a row for each modulus."""
        sheet, parts = self.sheet, self.sheet.effects
        plane, found = [name for name in PLANE if name in parts], []
        if 'bend' in parts:
            curved = np.zeros(3 * len(sheet.rest))
            curved[2::3] = 0.5 * sheet.rest[:, 0]**2
            found.append(self.alone('bend', 'N m', parts['bend'].jacobian @ curved, ['bend']))
        if 'hinge' in parts:
            found.append(self.alone('hinge', 'N m', np.ones(len(parts['hinge'].blocks)),
                                    ['hinge']))
        if 'area' in parts:    # α is A0 over what is asked
            found.append(self.alone('area', 'N/m', parts['area'].blocks.ravel(), plane))
        if 'shear' in parts:
            sheared = np.zeros(3 * len(sheet.rest))
            sheared[0::3] = sheet.rest[:, 1]
            found.append(self.alone('shear', 'N/m', parts['shear'].jacobian @ sheared, plane))
        taut = 'pressure' in parts and len(plane) > 1
        return found + (self.blown_up(plane) if taut else self.hung(plane))

    def law(self, names: list[str], held=()) -> Law:
        """Return the law of some effects."""
        return law_of(self.sheet, names, self.solver, self.frame_dt, held=held,
                      damping=self.rate)

    def at(self, names: list[str], name: str) -> np.ndarray:
        """Return the rows that an effect has in the law of some."""
        sizes = {n: self.sheet.effects[n].jacobian.shape[0] for n in names}
        first = sum(sizes[n] for n in names[:names.index(name)])
        return first + np.arange(sizes[name])

    def alone(self, name: str, unit: str, residual: np.ndarray, names: list[str]) -> Row:
        """Return the row of an effect that is displaced, and no other."""
        law, rows = self.law(names), self.at(names, name)
        tension = np.zeros(law.coupling.shape[0])
        tension[rows] = self.sheet.effects[name].stiffness @ residual
        modulus = self.asked[name].stiffness or self.asked[name].warp
        return self.row(name, None, unit, modulus, law, tension, rows)

    def directions(self, names: list[str]):
        """Yield effect, direction, axis, modulus and rows of moduli along warp and weft."""
        for name in ('membrane', 'stretch'):
            if name not in names:
                continue
            rows, along = self.at(names, name), self.sheet.effects[name].along
            for axis, direction in ((WARP, 'warp'), (WEFT, 'weft')):
                if name == 'membrane':
                    yield name, direction, axis, self.asked[name].moduli[axis], rows[axis::3]
                elif (along == axis).any():
                    modulus = getattr(self.asked[name], direction)
                    if modulus is None:    # a compliance of every edge alike
                        alpha = self.asked[name].compliance
                        modulus = 1.0 / alpha if alpha else np.inf
                    yield name, direction, axis, modulus, rows[along == axis]

    def hung(self, names: list[str]) -> list[Row]:
        """Return rows of what hangs from one side and then the other."""
        found, loads = [], {}
        for name, direction, axis, modulus, rows in self.directions(names):
            if axis not in loads:
                loads[axis] = (self.law(names, hung_side(self.sheet, axis)),
                               hanging(self.sheet, axis, EARTH, names))
            found.append(self.row(name, direction, 'N/m', modulus, *loads[axis], rows))
        return found

    def blown_up(self, names: list[str]) -> list[Row]:
        """
        Return rows of a skin under its gas, and of the overpressure that comes of both.

        With tensions T and stretches C of skin and gas under 1 Pa, virtual work has T·C the
        volume that 1 Pa makes room for, so that the gas's excess leaves (V* - V) / T·C.
        """
        law, tension = self.law(names), blown_up(self.sheet, names)
        found = [self.row(name, direction, 'N/m', modulus, law, tension, rows)
                 for name, direction, _, modulus, rows in self.directions(names)]
        wanted = self.sheet.excess / (tension @ (law.compliance @ tension))
        given = tension @ law.stretches(tension)
        if abs(wanted) > LEAST:
            left = self.sheet.excess / given if given > 0.0 else np.inf
            found.append(Row(self.sheet.name, 'pressure', None, 'Pa', float(wanted),
                             *[float(left)] * 3))
        return found

    def row(self, name: str, direction: str | None, unit: str, modulus: float, law: Law,
            tension: np.ndarray, rows: np.ndarray) -> Row:
        """Return what some rows of a law give under tensions."""
        return _row(self.sheet.name, name, direction, unit, modulus / self.scale, law, tension,
                    rows)


def _row(cloth: str, effect: str, direction: str | None, unit: str, asked: float, law: Law,
         tension: np.ndarray, rows: np.ndarray) -> Row:
    given = law.stretches(tension)[rows]
    wanted, tension = (law.compliance @ tension)[rows], tension[rows]
    seen = np.abs(tension) >= SEEN * np.abs(tension).max()
    sign, given, wanted, tension = (a[seen] for a in (np.sign(tension), given, wanted, tension))
    with np.errstate(divide='ignore'):
        if np.isinf(asked):
            mean, each = np.abs(tension).sum() / (sign * given).sum(), tension / given
        else:
            mean = asked * (sign * wanted).sum() / (sign * given).sum()
            each = asked * wanted / given
    each = np.where(sign * given > 0.0, each, np.inf)
    mean = mean if mean > 0.0 else np.inf    # gives nothing, but for rounding
    return Row(cloth, effect, direction, unit, float(asked), float(mean), float(each.min()),
               float(each.max()))
