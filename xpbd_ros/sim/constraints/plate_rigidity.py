"""
Bending rigidities of a mesh's hinges, fitted so that the mesh bends as an orthotropic plate.

Hinge h has the energy b_h |C_h|² / 2, with C = Σ K_i x_i / sqrt(A0 + A1)
(``constraints.isometric_bending``). In a flat sheet bent to the curvature κ = (κ11, κ22, κ12),
C = a·κ with a from the rest shape alone; but particles deviate from that surface by heights u
that lower the energy, so

    C = a·κ + K u,   u = argmin Σ b C² / 2,   u = 0 on the boundary and next to it

and the energy is E(κ) = Σ b C² / 2. A plate with B1 along warp, B2 along weft and
D66 = sqrt(B1 B2) / 2 for twist (Huber 1923), rolled along a direction (c, s) from warp, has

    κ² (√B1 c² + √B2 s²)² / 2 per area,

with five coefficients, of c⁴, s⁴, c²s², c³s and cs³. Equal b for all hinges miss them by 6 to 43 %
on an irregular mesh, and by more the more B1 and B2 differ, since a hinge resists bending in other
directions than across its edge too. The fit starts with b equal to the plate's rigidity across
each edge, and finds the smallest relative change (least squares) that gives the five coefficients,
by Newton's method on E. Triangles on the boundary lack hinges; the hinges that they have count for
their whole area.

Limits: bending in two directions at once is not fitted. A strip that is free to curl is about 11 %
softer than the plate, and the more so the more B1 and B2 differ. A mesh that is not flat, or has
no particle more than an edge away from its boundary, keeps the b that the fit starts from.

All sums have a fixed order and no step calls a numerical library, since b determines the bits of a
run.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.constraints.isometric_bending import isometric_weights
from xpbd_ros.sim.geometry.mesh import cross, dot, length, Mesh, triangle_areas

FLAT = 1e-6
"""largest height of a flat mesh, relative to its size"""
LEAST, MOST = 0.05, 10.0
"""bounds of b, relative to the plate's rigidity across the edge"""
LARGEST = 1e6
"""largest ratio of B1 and B2 (or B2 and B1) that is fitted"""
ROUNDS, SWEEPS = 24, 30
"""steps of Newton's method, and of conjugate gradients for u in each of them"""
STEP = 0.5
"""largest relative change of b in one step of Newton's method"""
GOOD = 1e-3
"""tolerance of the five coefficients, relative"""
ROLLED, STRIP = 0.05, 0.25
"""relative errors above which the user gets a note: of a rolled sheet, and of a strip that is free
to curl"""


class Plate(NamedTuple):
    """Rigidities of a mesh's hinges, and of the sheet that they give."""

    rigidity: np.ndarray
    """b of each hinge [N m], shape (hinges,)"""
    rolled: tuple[float, float] | None
    """bending rigidity of the sheet rolled along warp and along weft [N m]; None: not fitted"""
    strip: tuple[float, float] | None
    """bending rigidity of a strip along warp and along weft that is free to curl [N m]; None: not
    fitted"""


def across(mesh: Mesh, hinges: np.ndarray, along_warp: float, along_weft: float) -> np.ndarray:
    """
    Return the rigidity of the plate across the edge of each hinge [N m], shape (hinges,).

    Bent along a direction at the angle φ from warp, the plate has (√B1 cos²φ + √B2 sin²φ)².
    """
    e = mesh.positions[hinges[:, 1]] - mesh.positions[hinges[:, 0]]
    along = dot(e, np.asarray(mesh.warp, float))**2 / dot(e, e)
    return (np.sqrt(along_warp) * (1.0 - along) + np.sqrt(along_weft) * along)**2


def plate(mesh: Mesh, along_warp: float, along_weft: float) -> Plate:
    """Return fitted rigidities for a plate of B1 along warp and B2 along weft [N m]."""
    mean = float(np.sqrt(along_warp) * np.sqrt(along_weft))
    ratio = min(max(along_warp / along_weft, 1.0 / LARGEST), LARGEST)
    found = _fitted(mesh, ratio)
    return Plate(mean * found.rigidity, *(None if both is None else (
        mean * both[0], mean * both[1]) for both in found[1:]))


@lru_cache(maxsize=8)    # a live change of both rigidities keeps their ratio
def _fitted(mesh: Mesh, ratio: float) -> Plate:
    """Return ``plate`` for B1 / B2 = ratio and B1 B2 = 1."""
    along_warp, along_weft = float(np.sqrt(ratio)), float(np.sqrt(1.0 / ratio))
    hinges = mesh.hinges
    b = across(mesh, hinges, along_warp, along_weft)
    axes = _plane(mesh)
    free = _inside(mesh)
    if axes is None or not free.any():
        return Plate(b, None, None)
    flat = np.stack([dot(mesh.positions, axis) for axis in axes], 1)
    corners = mesh.positions[hinges]
    weights = isometric_weights(corners)
    here = flat[hinges] - flat[hinges].mean(1, keepdims=True)
    s, t = here[..., 0], here[..., 1]
    a = np.stack([(weights * m).sum(1) for m in (0.5 * s * s, 0.5 * t * t, s * t)], 1)
    share = _areas(mesh)
    b *= share / (triangle_areas(corners[:, [0, 1, 2]])
                  + triangle_areas(corners[:, [0, 1, 3]])) * 3.0
    counted = np.where(free[hinges].any(1), share, 0.0)
    asked = np.array([along_warp, along_weft, 2.0, 0.0, 0.0])
    least, most, best = LEAST * b, MOST * b, np.inf
    solve_heights = _HeightSolver(hinges, weights, free)
    for _ in range(ROUNDS):
        c = solve_heights(a, b)
        density = b[:, None] * _rolled(c) / share[:, None]
        weighted = density * (counted / counted.sum())[:, None]
        now = weighted.sum(0)
        off = now[:2] / asked[:2]
        worst = max(off.max(), (1.0 / off).max(), 1.0 + np.abs(now - asked)[2:].max())
        if worst < best:
            best, chosen, energy = worst, b, (b * (counted > 0.0))[:, None, None] * (
                c[:, :, None] * c[:, None, :]) / counted.sum()
        if worst < 1.0 + GOOD:
            break
        unit = np.maximum(now, asked)
        unit[2:] = np.sqrt(unit[0]) * np.sqrt(unit[1])
        left, density, weighted = (asked - now) / unit, density / unit, weighted / unit
        system = (weighted[:, :, None] * density[:, None, :]).sum(0)
        system += GOOD * np.trace(system) / 5.0 * np.eye(5)
        change = (density * _solved(system, left)).sum(1)
        b = np.minimum(np.maximum(b * (1.0 + np.minimum(np.maximum(change, -STEP), STEP)), least),
                       most)
    (d11, d12, d16), (_, d22, d26), (_, _, d66) = energy.sum(0)
    determinant = (d11 * (d22 * d66 - d26 * d26) - d12 * (d12 * d66 - d26 * d16)
                   + d16 * (d12 * d26 - d22 * d16))
    return Plate(chosen, (d11, d22), (determinant / (d22 * d66 - d26 * d26),
                                      determinant / (d11 * d66 - d16 * d16)))


def shortfall(found: Plate, along_warp: float, along_weft: float) -> str | None:
    """Return a note on the errors of the fit, for the user; None if they are small."""
    if found.rolled is None or found.strip is None:
        return None if along_warp == along_weft else (
            'the mesh is not flat, or all its particles are at the boundary or next to it, so its '
            'hinges are not fitted to warp and weft; they may be several times as stiff along the '
            'softer one as asked')
    asked = (along_warp, along_weft)
    off = [max((abs(got / want - 1.0) for got, want in zip(both, asked)), default=0.0)
           for both in (found.rolled, found.strip)]
    if off[0] <= ROLLED and off[1] <= STRIP:
        return None
    (w, f), (p, q) = found.rolled, found.strip
    return (f'the hinges of this mesh cannot bend as asked: {along_warp:.3g} N m along warp and '
            f'{along_weft:.3g} along weft come out as {w:.3g} and {f:.3g}, in a strip that is '
            f'free to curl as {p:.3g} and {q:.3g}; take a grid, or a mesh with edges along both')


def _plane(mesh: Mesh) -> tuple[np.ndarray, np.ndarray] | None:
    """Return unit vectors along and across the warp of a flat mesh; None if it is not flat."""
    x = mesh.positions[mesh.triangles]
    normals = cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    if not len(normals):
        return None
    normal = normals.sum(0)
    if length(normal) < (1.0 - FLAT) * length(normals).sum():
        return None
    normal = normal / length(normal)
    used = x - mesh.positions[mesh.triangles[0, 0]]
    if np.abs(dot(used, normal)).max() > FLAT * np.abs(used).max():
        return None
    along = np.asarray(mesh.warp, float)
    along = along - dot(along, normal) * normal
    if length(along) < FLAT:
        return None
    along = along / length(along)
    return along, cross(normal, along)


def _inside(mesh: Mesh) -> np.ndarray:
    """Return True for particles neither on the boundary nor next to it, shape (particles,)."""
    count = len(mesh.positions)
    sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    keys, often = np.unique(sides @ [count, 1], return_counts=True)
    rim = np.zeros(count, bool)
    rim[np.stack(np.divmod(keys[often == 1], count))] = True
    beside = rim.copy()
    beside[mesh.edges[rim[mesh.edges].any(1)]] = True
    return ~beside


def _areas(mesh: Mesh) -> np.ndarray:
    """Return the tributary area of each hinge [m²]: triangles are divided among their hinges."""
    count = len(mesh.positions)
    sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]], 2) @ [count, 1]
    keys = np.sort(mesh.hinges[:, :2], 1) @ [count, 1]
    order = np.argsort(keys)
    place = np.minimum(np.searchsorted(keys, sides, sorter=order), len(keys) - 1)
    there = keys[order[place]] == sides
    part = triangle_areas(mesh.positions[mesh.triangles]) / np.maximum(there.sum(1), 1)
    return np.bincount(order[place][there], np.repeat(part[:, None], 3, 1)[there], len(keys))


def _rolled(c: np.ndarray) -> np.ndarray:
    """Return coefficients of x⁴, y⁴, x²y², x³y, xy³ in (c·(x², y², x y))², shape (hinges, 5)."""
    x, y, z = c.T
    return np.stack([x * x, y * y, 2.0 * x * y + z * z, 2.0 * x * z, 2.0 * y * z], 1)


class _HeightSolver:
    """Heights u that minimise Σ b (a + K u)² / 2, by conjugate gradients, for κ11, κ22, κ12."""

    def __init__(self, hinges, weights, free):
        self._hinges, self._weights, self._free = hinges, weights, free[:, None]
        self._u = np.zeros((len(free), 3))

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return a + K u after SWEEPS steps from the last u, shape (hinges, 3)."""
        u = self._u
        moment = b[:, None] * self._weights
        per = self._gathered(moment * self._weights, np.ones((len(b), 3)))
        per = np.where(self._free & (per > 0.0), 1.0 / np.where(per > 0.0, per, 1.0), 0.0)
        r = -self._gathered(moment, a + self._folds(u))
        z = per * r
        p, size = z, (r * z).sum(0)
        for _ in range(SWEEPS):
            pulled = self._gathered(moment, self._folds(p))
            bent = (p * pulled).sum(0)
            step = np.where(bent > 0.0, size / np.where(bent > 0.0, bent, 1.0), 0.0)
            u, r = u + step * p, r - step * pulled
            z = per * r
            now = (r * z).sum(0)
            p = z + np.where(size > 0.0, now / np.where(size > 0.0, size, 1.0), 0.0) * p
            size = now
        self._u = u
        return a + self._folds(u)

    def _folds(self, u: np.ndarray) -> np.ndarray:
        """Return K u of each hinge, shape (hinges, 3)."""
        found = np.zeros((len(self._hinges), 3))
        _fold(self._hinges, self._weights, u, found)
        return found

    def _gathered(self, moment: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return Kᵀ b c of the free particles, shape (particles, 3)."""
        found = np.zeros(self._u.shape)
        _gather(self._hinges, moment, c, found)
        return np.where(self._free, found, 0.0)


@jit
def _fold(hinges, weights, u, found):
    for h in range(len(hinges)):
        for k in range(4):
            for m in range(3):
                found[h, m] += weights[h, k] * u[hinges[h, k], m]


@jit
def _gather(hinges, moment, c, found):
    for h in range(len(hinges)):
        for k in range(4):
            for m in range(3):
                found[hinges[h, k], m] += moment[h, k] * c[h, m]


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a symmetric positive definite system, by elimination."""
    m, x = matrix.copy(), right.copy()
    n = len(x)
    for i in range(n):
        for j in range(i + 1, n):
            part = m[j, i] / m[i, i]
            m[j] -= part * m[i]
            x[j] -= part * x[i]
    for i in range(n - 1, -1, -1):
        x[i] = (x[i] - (m[i, i + 1:] * x[i + 1:]).sum()) / m[i, i]
    return x
