"""
Even loads on a cloth, and the tensions that they ask for: what its stiffness is measured by.

``stretch``: the cloth hangs flat from one whole side, warp down and then weft down; from the side
nearest to its pins where the scene has some. ``shear``: sheared evenly. ``bend``: rolled evenly.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from xpbd_ros.sim.simulation import Simulation

SOFT = 1e-9
"""of the mean stiffness: holds what no constraint holds"""
STIFF = 1e-12
"""compliance of a rigid edge while tensions are sought, relative to the softest"""


@dataclass(frozen=True)
class Sheet:
    """One cloth of a simulation at its rest shape, numbered by itself."""

    name: str
    rest: np.ndarray
    """[m], shape (particles, 3)"""
    inv_mass: np.ndarray
    """[1/kg], all free; shape (particles,)"""
    held: np.ndarray
    """particles that the scene pins"""
    effects: dict[str, 'Part']
    crowd: int
    """most constraints at a particle, of the whole scene"""


@dataclass(frozen=True)
class Part:
    """One effect's constraints on a cloth, in sweep order."""

    particles: np.ndarray
    """shape (constraints, 2 or 4)"""
    jacobian: sparse.csr_matrix
    compliance: np.ndarray
    along: np.ndarray
    """0: nearer to warp, 1: nearer to weft; shape (constraints,)"""


def sheets(simulation: Simulation) -> list[Sheet]:
    """Return the grids of a simulation, with the constraints of their stretch, shear and bend."""
    number = np.full(simulation.state.x.shape[1], -1)
    number[simulation.slot] = np.arange(len(simulation.slot))
    count = np.zeros(simulation.state.x.shape[1], int)
    for built in simulation.effects.values():
        if built.constraints is not None:
            np.add.at(count, built.constraints.particles, 1)
    found = []
    for cloth in simulation.cloths:
        if cloth.mesh.grid is None:
            continue
        rest, first = cloth.mesh.positions, cloth.particles.start
        slots = simulation.slot[cloth.particles]
        effects = {}
        for name in ('bend', 'shear', 'stretch'):
            if name not in simulation.effects:
                continue
            listed = simulation.effects[name].constraints
            particles = number[listed.particles] - first
            here = ((particles >= 0) & (particles < len(rest))).all(1)
            if here.any():
                effects[name] = _part(rest, particles[here], listed, here)
        found.append(Sheet(cloth.name, rest, 1.0 / simulation.state.mass[slots].astype(float),
                           np.flatnonzero(simulation.state.inv_mass[slots] == 0.0), effects,
                           int(count.max(initial=1))))
    return found


def _part(rest, particles, listed, here) -> Part:
    d = rest[particles[:, 0]] - rest[particles[:, 1]]
    along = (np.abs(d[:, 1]) > np.abs(d[:, 0])).astype(int)
    if particles.shape[1] == 2:
        u = d / np.linalg.norm(d, axis=1)[:, None]
        values = np.stack([u, -u], 1)    # C grows along u at the first particle
    else:
        values = np.zeros((len(particles), 4, 3))    # flat: only what leaves the sheet bends it
        values[:, :, 2] = listed.weight[here]
    rows = np.arange(len(particles))[:, None, None] + np.zeros(values.shape, int)
    columns = 3 * particles[:, :, None] + np.arange(3)
    jacobian = sparse.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())),
                                 (len(particles), 3 * len(rest)))
    return Part(particles, jacobian, listed.compliance[here], along)


def hung_side(sheet: Sheet, axis: int) -> np.ndarray:
    """Return the particles of the side that a sheet hangs from along warp (0) or weft (1)."""
    place = sheet.rest[:, axis]
    low, high = place.min(), place.max()
    near = sheet.rest[sheet.held, axis].mean() if len(sheet.held) else low
    end, inward = (low, 1.0) if near <= 0.5 * (low + high) else (high, -1.0)
    reach = 1e-6 * (high - low)
    return np.flatnonzero(inward * (place - end) <= reach)


def hanging(sheet: Sheet, axis: int, gravity: float, names: list[str]) -> np.ndarray:
    """Return the tension of each edge of some effects [N] where the sheet hangs from a side."""
    J = sparse.vstack([sheet.effects[name].jacobian for name in names]).tocsr()
    alpha = np.concatenate([sheet.effects[name].compliance for name in names])
    stiff = 1.0 / np.maximum(alpha, STIFF * max(alpha.max(), 1e-12))
    side = hung_side(sheet, axis)
    down = np.zeros(sheet.rest.shape)
    middle = sheet.rest[:, axis].mean()
    down[:, axis] = np.sign(middle - sheet.rest[side[0], axis]) * gravity / sheet.inv_mass
    free = np.ones(len(sheet.rest), bool)
    free[side] = False
    dofs = np.flatnonzero(np.repeat(free, 3))
    Jf = J[:, dofs]
    K = (Jf.T @ sparse.diags(stiff) @ Jf).tocsc()
    K = K + SOFT * K.diagonal().mean() * sparse.identity(K.shape[0])
    u = splu(K.tocsc()).solve(down.ravel()[dofs])
    return stiff * (Jf @ u)
