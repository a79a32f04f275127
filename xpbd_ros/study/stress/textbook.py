"""
A textbook XPBD solver, as published, for comparison; one thread, one constraint after another.

Macklin et al. 2016, algorithm 1: explicit forces, prediction, Gauss-Seidel over edges, hinges
(Müller et al. 2006, appendix, with arccos), tetrahedra and contacts, velocities from positions,
and friction that scales velocities. Pins and colliders jump to their targets; lengths below
EPSILON are skipped. It shares no code with the simulation.
"""

from typing import NamedTuple

from numba import njit
import numpy as np

EPSILON = 1e-6
"""lengths below this are skipped [m]"""
PLANE, SPHERE, BOX, CAPSULE = range(4)


class Model(NamedTuple):
    """The constant data of a run; indices are those of particles."""

    mass: np.ndarray
    """[kg], shape (particles,)"""
    edges: np.ndarray
    """shape (edges, 2)"""
    rest: np.ndarray
    """[m], shape (edges,)"""
    alpha: np.ndarray
    """[m/N], shape (edges,)"""
    hinges: np.ndarray
    """edge start, end, both opposite; shape (hinges, 4)"""
    angle: np.ndarray
    """[rad], shape (hinges,)"""
    hinge_alpha: np.ndarray
    """[1/(N m)], shape (hinges,)"""
    tetrahedra: np.ndarray
    """shape (tetrahedra, 4)"""
    volume: np.ndarray
    """[m³], shape (tetrahedra,)"""
    triangles: np.ndarray
    """triangles with drag, shape (triangles, 3)"""
    kind: np.ndarray
    """PLANE, SPHERE, BOX or CAPSULE, shape (colliders,)"""
    size: np.ndarray
    """normal; radius; half extents; or radius and half length [m], shape (colliders, 3)"""
    thickness: float
    """contact distance [m]"""
    friction: float
    """coefficient μ"""
    apart: float
    """self-collision distance [m]; 0 for none"""
    gravity: np.ndarray
    """[m/s²], shape (3,)"""


@njit(error_model='numpy')
def advance(model, x, v, w, pinned, target, centre, air, dt, substeps, iterations):
    """
    Advance by one frame, in place.

    Parameters
    ----------
    model : constant data
    x, v : positions [m] and velocities [m/s], shape (particles, 3)
    w : inverse masses [1/kg], 0 while pinned, shape (particles,)
    pinned, target : indices of pinned particles and their positions [m]
    centre : positions of the colliders [m], shape (colliders, 3)
    air : velocity [m/s] and density [kg/m³] of the air, shape (4,)
    dt : frame period [s]
    substeps, iterations : numbers of them

    """
    n = len(x)
    h = dt / substeps
    before = np.empty_like(x)
    multiplier = np.zeros(len(model.edges))
    hinge_multiplier = np.zeros(len(model.hinges))
    touched = np.zeros(n, np.int64)
    for _ in range(substeps):
        _blow(model, x, v, w, air, h)
        for i in range(n):
            before[i] = x[i]
            if w[i] > 0.0:
                v[i] += h * model.gravity
                x[i] += h * v[i]
        for k in range(len(pinned)):
            x[pinned[k]] = target[k]
        multiplier[:] = 0.0
        hinge_multiplier[:] = 0.0
        touched[:] = 0
        for _ in range(iterations):
            _edges(model, x, w, multiplier, h)
            _hinges(model, x, w, hinge_multiplier, h)
            _tetrahedra(model, x, w)
            _contacts(model, x, w, centre, touched)
            _itself(model, x, w)
        for i in range(n):
            v[i] = (x[i] - before[i]) / h
            if touched[i]:
                v[i] *= max(0.0, 1.0 - model.friction)


@njit(error_model='numpy')
def _blow(model, x, v, w, air, h):
    if air[3] == 0.0:
        return
    for a, b, c in model.triangles:
        normal = np.cross(x[b] - x[a], x[c] - x[a])
        size = np.sqrt((normal * normal).sum())
        if size < EPSILON * EPSILON:
            continue
        normal = normal / size
        u = air[:3] - (v[a] + v[b] + v[c]) / 3.0
        across = (u * normal).sum()
        along = u - across * normal
        force = 0.25 * air[3] * size * (1.2 * abs(across) * across * normal
                                        + 0.02 * np.sqrt((along * along).sum()) * along)
        for i in (a, b, c):
            v[i] += h * w[i] * force / 3.0


@njit(error_model='numpy')
def _edges(model, x, w, multiplier, h):
    for e in range(len(model.edges)):
        i, j = model.edges[e]
        total = w[i] + w[j]
        if total == 0.0:
            continue
        d = x[i] - x[j]
        length = np.sqrt((d * d).sum())
        if length < EPSILON:
            continue
        alpha = model.alpha[e] / (h * h)
        change = -(length - model.rest[e] + alpha * multiplier[e]) / (total + alpha)
        multiplier[e] += change
        n = d / length
        x[i] += w[i] * change * n
        x[j] -= w[j] * change * n


@njit(error_model='numpy')
def _hinges(model, x, w, multiplier, h):
    for k in range(len(model.hinges)):
        a, b, c, d = model.hinges[k]
        p2, p3, p4 = x[b] - x[a], x[c] - x[a], x[d] - x[a]
        m1, m2 = np.cross(p2, p3), np.cross(p2, p4)
        l1, l2 = np.sqrt((m1 * m1).sum()), np.sqrt((m2 * m2).sum())
        if l1 < EPSILON * EPSILON or l2 < EPSILON * EPSILON:
            continue
        n1, n2 = m1 / l1, m2 / l2
        cosine = min(1.0, max(-1.0, (n1 * n2).sum()))
        q3 = (np.cross(p2, n2) + np.cross(n1, p2) * cosine) / l1
        q4 = (np.cross(p2, n1) + np.cross(n2, p2) * cosine) / l2
        q2 = (-(np.cross(p3, n2) + np.cross(n1, p3) * cosine) / l1
              - (np.cross(p4, n1) + np.cross(n2, p4) * cosine) / l2)
        q1 = -q2 - q3 - q4
        sine = np.sqrt(1.0 - cosine * cosine)
        total = (w[a] * (q1 * q1).sum() + w[b] * (q2 * q2).sum() + w[c] * (q3 * q3).sum()
                 + w[d] * (q4 * q4).sum())
        if total < EPSILON * EPSILON or sine < EPSILON:
            continue
        alpha = model.hinge_alpha[k] / (h * h)
        # with grad θ = -q / sin θ of the angle between the normals
        fold = np.arccos(cosine)
        change = -(fold - (np.pi - abs(model.angle[k])) + alpha * multiplier[k]) / (
            total / (sine * sine) + alpha)
        multiplier[k] += change
        share = -change / sine
        x[a] += w[a] * share * q1
        x[b] += w[b] * share * q2
        x[c] += w[c] * share * q3
        x[d] += w[d] * share * q4


@njit(error_model='numpy')
def _tetrahedra(model, x, w):
    for k in range(len(model.tetrahedra)):
        a, b, c, d = model.tetrahedra[k]
        g1 = np.cross(x[d] - x[b], x[c] - x[b]) / 6.0
        g2 = np.cross(x[c] - x[a], x[d] - x[a]) / 6.0
        g3 = np.cross(x[d] - x[a], x[b] - x[a]) / 6.0
        g4 = np.cross(x[b] - x[a], x[c] - x[a]) / 6.0
        total = (w[a] * (g1 * g1).sum() + w[b] * (g2 * g2).sum() + w[c] * (g3 * g3).sum()
                 + w[d] * (g4 * g4).sum())
        if total == 0.0:
            continue
        volume = (g4 * (x[d] - x[a])).sum()
        change = -(volume - model.volume[k]) / total
        x[a] += w[a] * change * g1
        x[b] += w[b] * change * g2
        x[c] += w[c] * change * g3
        x[d] += w[d] * change * g4


@njit(error_model='numpy')
def _contacts(model, x, w, centre, touched):
    n = np.zeros(3)
    for c in range(len(model.kind)):
        for i in range(len(x)):
            if w[i] == 0.0:
                continue
            p = x[i] - centre[c]
            n[:] = 0.0
            if model.kind[c] == PLANE:
                n[:] = model.size[c]
                gap = (p * n).sum()
            elif model.kind[c] == BOX:
                gap = _box(p, model.size[c], n)
            else:
                if model.kind[c] == CAPSULE:
                    p[2] -= min(model.size[c, 1], max(-model.size[c, 1], p[2]))
                length = np.sqrt((p * p).sum())
                gap = length - model.size[c, 0]
                n[:] = p / length
            if gap < model.thickness:
                x[i] += (model.thickness - gap) * n
                touched[i] = 1


@njit(error_model='numpy')
def _box(p, half, n):
    inside, axis = -np.inf, 0
    square = 0.0
    for k in range(3):
        q = abs(p[k]) - half[k]
        if q > inside:
            inside, axis = q, k
        if q > 0.0:
            n[k] = np.sign(p[k]) * q
            square += q * q
    if square > 0.0:
        length = np.sqrt(square)
        n /= length
        return length
    n[axis] = np.sign(p[axis])
    return inside


@njit(error_model='numpy')
def _itself(model, x, w):
    if model.apart == 0.0:
        return
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            total = w[i] + w[j]
            if total == 0.0:
                continue
            d = x[i] - x[j]
            length = np.sqrt((d * d).sum())
            if EPSILON < length < model.apart:
                push = (model.apart - length) / (length * total)
                x[i] += w[i] * push * d
                x[j] -= w[j] * push * d
