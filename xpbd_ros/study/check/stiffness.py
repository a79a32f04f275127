"""The stiffness that a setting really gives, predicted before anything runs."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Simulation, Solver
from xpbd_ros.study.check.law import APART, BACK, FORTH, Law, WHOLE
from xpbd_ros.study.check.loads import hanging, hung_side, Sheet, sheets

WARP, WEFT = 0, 1
SEEN = 0.01
"""constraints under less than this part of the largest tension say nothing about stiffness"""
SHARE = {'backward_euler': 1.0, 'leapfrog': 1.0, 'bdf2': 2.0 / 3.0, 'ndf2': 0.6}
"""H of an integrator, in substeps"""
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
    Return the law for some effects of a flat sheet.

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
    sizes = np.cumsum([0, *(len(part.compliance) for part in parts)])
    rows = {name: np.arange(a, b) for name, a, b in zip(names, sizes[:-1], sizes[1:])}
    everything = np.arange(sizes[-1])
    if solver.method == 'line':
        others = np.concatenate([rows[name] for name in names if name != 'stretch']
                                or [np.zeros(0, int)])
        passes = [(FORTH, others)]
        if 'stretch' in rows:
            edges, along = rows['stretch'], sheet.effects['stretch'].along
            passes += [(WHOLE, edges[along == WARP]), (WHOLE, edges[along == WEFT]),
                       (BACK, others), (FORTH, edges)]
        else:
            passes.append((BACK, others))
    elif solver.method == 'gauss_seidel_symmetric':
        passes = [(FORTH, everything), (BACK, everything)]
    elif solver.method == 'jacobi':
        passes = [(APART, everything)]
    elif solver.method == 'explicit':
        passes = []
    else:
        passes = [(FORTH, everything)]
    return Law(sparse.vstack([part.jacobian for part in parts]).tocsr(),
               np.concatenate([part.compliance for part in parts]), mobility, tuple(passes),
               solver.iterations, 1.0 / sheet.crowd)


def stiffness(scene: Scene, simulation: Simulation, solver: Solver) -> list[Row]:
    """Return a row for each modulus of each cloth at some setting."""
    frame_dt = simulation.frame_dt
    rate = scene.effects['damping'].rate if 'damping' in scene.effects else 0.0
    found = []
    for sheet in sheets(simulation):
        asked = scene.cloth_effects[sheet.name]
        scale = scene.top.solver.compliance_scale
        edges = [name for name in ('shear', 'stretch') if name in sheet.effects]
        if 'bend' in sheet.effects:
            law = law_of(sheet, ['bend'], solver, frame_dt, damping=rate)
            curved = np.zeros(3 * len(sheet.rest))
            curved[2::3] = 0.5 * sheet.rest[:, 0]**2
            found.append(_row(sheet.name, 'bend', None, 'N m', asked['bend'].stiffness / scale,
                              law, law.jacobian @ curved / law.compliance))
        if 'shear' in sheet.effects:
            law = law_of(sheet, edges, solver, frame_dt, damping=rate)
            sheared = np.zeros(3 * len(sheet.rest))
            sheared[0::3] = sheet.rest[:, 1]
            count = len(sheet.effects['shear'].compliance)
            tension = np.zeros(len(law.compliance))
            tension[:count] = (law.jacobian @ sheared)[:count] / law.compliance[:count]
            found.append(_row(sheet.name, 'shear', None, 'N/m', asked['shear'].stiffness / scale,
                              law, tension))
        if 'stretch' in sheet.effects:
            found += _stretch(sheet, asked['stretch'], scale, edges, solver, frame_dt, rate)
    return found


def _stretch(sheet, asked, scale, edges, solver, frame_dt, rate) -> list[Row]:
    found = []
    along = sheet.effects['stretch'].along
    before = sum(len(sheet.effects[name].compliance) for name in edges if name != 'stretch')
    for axis, direction in ((WARP, 'warp'), (WEFT, 'weft')):
        if not (along == axis).any():
            continue
        modulus = getattr(asked, direction)
        if modulus is None:    # a compliance of every edge alike
            modulus = 1.0 / asked.compliance if asked.compliance else np.inf
        law = law_of(sheet, edges, solver, frame_dt, held=hung_side(sheet, axis), damping=rate)
        tension = hanging(sheet, axis, EARTH, edges)
        found.append(_row(sheet.name, 'stretch', direction, 'N/m', modulus / scale, law, tension,
                          before + np.flatnonzero(along == axis)))
    return found


def _row(cloth: str, effect: str, direction: str | None, unit: str, asked: float, law: Law,
         tension: np.ndarray, rows=slice(None)) -> Row:
    given = law.stretches(tension)[rows]
    wanted, tension = (law.compliance * tension)[rows], tension[rows]
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
