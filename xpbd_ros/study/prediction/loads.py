"""
Uniform loads on a cloth, and the tensions that balance them, to measure its stiffness.

``stretch`` and ``membrane``: the cloth hangs flat from one whole side, once with warp and once
with weft down; from the side closest to its pins, if the scene has any. With ``pressure`` it is
inflated instead. ``shear``: uniform shear. ``bend``: uniform curvature. ``hinge`` and ``area``:
the same fold of each hinge, the same relative growth of each triangle.
"""

from dataclasses import dataclass, replace
from math import inf

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from xpbd_ros.sim.geometry.mesh import Mesh
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.study.numbering import natural_indices

SOFT = 1e-9
"""stiffness of a spring that holds each particle, over the mean stiffness of the cloth"""
CAP = 0.05
"""part of the length of a mesh whose particles are held, as a mesh has no row at its end"""
STIFF = 1e-12
"""compliance of a rigid edge for the computation of tensions, over that of the softest edge"""


@dataclass(frozen=True)
class Sheet:
    """One cloth of a simulation at its rest shape, with particles numbered from 0."""

    name: str
    rest: np.ndarray
    """rest positions: along warp, across it, along the normal [m], shape (particles, 3)"""
    inv_mass: np.ndarray
    """inverse masses without pins [1/kg], shape (particles,)"""
    held: np.ndarray
    """indices of the particles that the scene pins"""
    effects: dict[str, 'ConstraintSet']
    """constraints by effect"""
    most_constraints: int
    """largest number of constraints at a particle, of the whole scene"""
    is_grid: bool
    packs: np.ndarray | None = None
    """number of the pack of paths (``constraints.mesh_paths``) of each edge of ``stretch``; None
    where it has no paths"""
    excess: float = 0.0
    """rest volume of its gas less the volume of its rest shape [m³]"""


@dataclass(frozen=True)
class ConstraintSet:
    """The linearised constraints of one effect on a cloth, in sweep order."""

    jacobian: sparse.csr_matrix
    """gradients, shape (rows, 3 particles); a constraint has b rows"""
    blocks: np.ndarray
    """α of each constraint, shape (constraints, b, b)"""
    along: np.ndarray
    """0 if closer to warp, 1 if closer to weft, shape (constraints,)"""
    rate: float = inf
    """stiffness over mass, as in ``Built.rate``"""

    @property
    def compliance(self) -> sparse.csr_matrix:
        """Block-diagonal matrix of α, shape (rows, rows)."""
        return _diagonal(self.blocks)

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """Inverse of ``compliance``, with STIFF for rigid constraints, shape (rows, rows)."""
        least = STIFF * max(self.blocks.max(initial=0.0), 1e-12)
        return _diagonal(np.linalg.inv(self.blocks + least * np.eye(self.blocks.shape[1])))


def _diagonal(blocks: np.ndarray) -> sparse.csr_matrix:
    count, b, _ = blocks.shape
    first, place = b * np.arange(count)[:, None, None], np.arange(b)
    rows, columns = (np.broadcast_to(first + k, blocks.shape)
                     for k in (place[:, None], place[None]))
    return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), [b * count] * 2)


def sheets(simulation: Simulation) -> list[Sheet]:
    """Return the cloths of a simulation with their constraints, linearised about rest."""
    number = natural_indices(simulation)
    count = np.zeros(simulation.state.x.shape[1], int)
    for built in simulation.effects.values():
        if built.constraints is not None:
            np.add.at(count, built.constraints.particles, 1)
    found = []
    for cloth in simulation.cloths:
        rest, first = in_axes(cloth.mesh), cloth.particles.start
        slots = simulation.slot[cloth.particles]
        places = np.zeros((simulation.state.x.shape[1], 3))
        places[slots] = rest
        effects, packs, excess = {}, None, 0.0
        for name, slopes in SLOPES.items():
            if name in simulation.effects:
                listed = simulation.effects[name].constraints
                particles = number[listed.particles] - first
                here = ((particles >= 0) & (particles < len(rest))).all(1)
                if here.any():
                    effects[name] = replace(_part(
                        rest, particles[here], slopes(listed, places)[here], listed, here),
                        rate=simulation.effects[name].rate)
                    if name == 'stretch' and cloth.mesh.grid is None:
                        packs = simulation.effects[name].packs
                        packs = None if packs is None else packs[here]
        if 'pressure' in simulation.effects:
            listed = simulation.effects['pressure'].constraints
            for triangles, volume, alpha in zip(listed.triangles, listed.rest_volume,
                                                listed.compliance):
                corners = number[triangles] - first
                if corners.min() >= 0 and corners.max() < len(rest):
                    effects['pressure'], own = _gas(rest, corners, alpha)
                    excess = volume - own
        found.append(Sheet(cloth.name, rest, 1.0 / simulation.state.mass[slots].astype(float),
                           np.flatnonzero(simulation.state.inv_mass[slots] == 0.0), effects,
                           int(count.max(initial=1)), cloth.mesh.grid is not None, packs,
                           excess))
    return found


def _part(rest, particles, slopes, listed, here) -> ConstraintSet:
    """Return constraints with gradients ``slopes``, shape (constraints, rows, particles, 3)."""
    d = rest[particles[:, 0]] - rest[particles[:, 1]]
    along = (np.abs(d[:, 1]) > np.abs(d[:, 0])).astype(int)
    count, b = slopes.shape[:2]
    rows = np.broadcast_to(np.arange(b * count).reshape(count, b, 1, 1), slopes.shape)
    columns = np.broadcast_to((3 * particles[:, :, None] + np.arange(3))[:, None], slopes.shape)
    jacobian = sparse.csr_matrix((slopes.ravel(), (rows.ravel(), columns.ravel())),
                                 (b * count, 3 * len(rest)))
    blocks = listed.block if hasattr(listed, 'block') else listed.compliance[:, None, None]
    return ConstraintSet(jacobian, blocks[here], along)


def _gas(rest, corners, alpha: float) -> tuple[ConstraintSet, float]:
    """Return the volume constraint of a closed surface, and its volume at rest [m³]."""
    sides = np.cross(rest[corners[:, [1, 2, 0]]], rest[corners[:, [2, 0, 1]]]) / 6.0
    slope = np.zeros(rest.shape)
    np.add.at(slope, corners, sides)
    return (ConstraintSet(sparse.csr_matrix(slope.reshape(1, -1)), np.full((1, 1, 1), alpha),
                          np.zeros(1, int)), float((rest[corners[:, 0]] * sides[:, 0]).sum()))


def in_axes(mesh: Mesh) -> np.ndarray:
    """Return rest positions along the warp, along the widest direction across it, and normal."""
    if mesh.grid is not None:
        return mesh.positions
    warp = np.asarray(mesh.warp, float)
    x = mesh.positions - mesh.positions.mean(0)
    flat = x - np.outer(x @ warp, warp)
    across = np.linalg.svd(flat, full_matrices=False)[2][0]
    return x @ np.stack([warp, across, np.cross(warp, across)], 1)


def _edges(listed, x):
    d = x[listed.particles[:, 0]] - x[listed.particles[:, 1]]
    l = np.linalg.norm(d, axis=1)[:, None]
    u = np.divide(d, l, out=np.zeros_like(d), where=l > 0.0)    # edges of other cloths have l = 0
    return np.stack([u, -u], 1)[:, None]


def _diagonals(listed, x):
    return _edges(listed, x) if listed.particles.shape[1] == 2 else listed.slopes(x.T)[:, None]


def _curvatures(listed, x):
    found = np.zeros((len(listed.weight), 1, 4, 3))    # all three axes are alike: one suffices
    found[:, 0, :, 2] = listed.weight
    return found


def _angles(listed, x):
    x0, x1, x2, x3 = (x[listed.particles[:, k]] for k in range(4))
    e, a, b = x1 - x0, x2 - x0, x3 - x0
    n, o = np.cross(e, a), np.cross(b, e)
    with np.errstate(invalid='ignore'):    # constraints of other cloths have no extent
        n, o = (v / (v * v).sum(1, keepdims=True) for v in (n, o))
        l = np.linalg.norm(e, axis=1)[:, None]
        s, t = ((v * e).sum(1, keepdims=True) / l for v in (a, b))
    return np.stack([(l - s) * n + (l - t) * o, s * n + t * o, -l * n, -l * o], 1)[:, None]


def _areas(listed, x):
    x0, x1, x2 = (x[listed.particles[:, k]] for k in range(3))
    n = np.cross(x1 - x0, x2 - x0)
    with np.errstate(invalid='ignore'):    # constraints of other cloths have no extent
        n /= 2.0 * np.linalg.norm(n, axis=1)[:, None]
    g, h = np.cross(x2 - x0, n), np.cross(n, x1 - x0)
    return np.stack([-g - h, g, h], 1)[:, None]


def _strains(listed, x):
    return listed.jacobian(x.T)


SLOPES = {'bend': _curvatures, 'cross_bend': _edges, 'hinge': _angles, 'area': _areas,
          'shear': _diagonals, 'membrane': _strains, 'stretch': _edges}
"""∂C/∂x of each constraint by its particles, shape (constraints, rows of each, particles, 3)"""


def hung_side(sheet: Sheet, axis: int) -> np.ndarray:
    """Return the indices of the particles that hold a sheet along warp (0) or weft (1)."""
    place = sheet.rest[:, axis]
    low, high = place.min(), place.max()
    near = sheet.rest[sheet.held, axis].mean() if len(sheet.held) else low
    end, inward = (low, 1.0) if near <= 0.5 * (low + high) else (high, -1.0)
    reach = (1e-6 if sheet.is_grid else CAP) * (high - low)
    return np.flatnonzero(inward * (place - end) <= reach)


def hanging_tensions(sheet: Sheet, axis: int, gravity: float, names: list[str]) -> np.ndarray:
    """Return the tensions of all rows of effects [N] in a sheet that hangs from a side."""
    J, stiff = matrices(sheet, names)
    side = hung_side(sheet, axis)
    down = np.zeros(sheet.rest.shape)
    middle = sheet.rest[:, axis].mean()
    down[:, axis] = np.sign(middle - sheet.rest[side[0], axis]) * gravity / sheet.inv_mass
    free = np.ones(len(sheet.rest), bool)
    free[side] = False
    dofs = np.flatnonzero(np.repeat(free, 3))
    return stiff @ (J[:, dofs] @ _displacement(J[:, dofs], stiff, down.ravel()[dofs]))


def inflated_tensions(sheet: Sheet, names: list[str]) -> np.ndarray:
    """Return the tensions of all rows of effects under 1 Pa; that of the pressure itself is -1."""
    gas = names.index('pressure')
    rest = names[:gas] + names[gas + 1:]
    push = sheet.effects['pressure'].jacobian.toarray().ravel()
    J, stiff = matrices(sheet, rest)
    tension = stiff @ (J @ _displacement(J, stiff, push))
    first = sum(sheet.effects[name].jacobian.shape[0] for name in names[:gas])
    return np.insert(tension, first, -1.0)


def matrices(sheet: Sheet, names: list[str]) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Return the Jacobian and the stiffness matrix of effects, stacked in the given order."""
    parts = [sheet.effects[name] for name in names]
    return (sparse.vstack([part.jacobian for part in parts]).tocsr(),
            sparse.block_diag([part.stiffness for part in parts]).tocsr())


def _displacement(J, stiff, force: np.ndarray) -> np.ndarray:
    """Return the static displacement by a force; SOFT makes the stiffness matrix regular."""
    K = (J.T @ stiff @ J).tocsc()
    K = K + SOFT * K.diagonal().mean() * sparse.identity(K.shape[0])
    return splu(K.tocsc()).solve(force)
