"""
Springs between particles, and the displacements at which their forces balance inertia.

Spring t pulls at Σ w x, with up to four particles and weights w, with the stiffness k. Newton's
method asks for the step of the particles' displacements x that closes what forces lack, r:

    (M + Σ k w wᵀ) Δx = r

Conjugate gradients with the diagonal for a preconditioner solve it, for one component or for the
two across an axis of each particle (Hestenes and Stiefel 1952). One thread does this: clamped
particles are few.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit

ITERATIONS = 80
"""most steps of one solve"""


class Springs(NamedTuple):
    """Springs, particles in an order of their own, and the vectors of the solver."""

    count: np.ndarray
    """number of springs, shape (1,)"""
    ends: np.ndarray
    """particles of each spring, shape (springs, 4)"""
    weight: np.ndarray
    """w, 0 for ends that are not used, shape (springs, 4)"""
    stiffness: np.ndarray
    """k where it acts [1 / mobility], shape (springs,)"""
    acting: np.ndarray
    """k at present, 0 where it does not act, shape (springs,)"""
    mass: np.ndarray
    """inverse of the mobility, 0 for fixed particles, shape (particles,)"""
    axis: np.ndarray
    """axis of each particle, shape (particles, 3)"""
    x: np.ndarray
    """displacements [m], shape (particles, 3); one component is the first"""
    missing: np.ndarray
    """r, shape (particles, 3)"""
    diagonal: np.ndarray
    """that of M + Σ k w wᵀ, shape (particles,)"""
    step: np.ndarray
    """Δx [m], shape (particles, 3)"""
    along: np.ndarray
    """search direction, likewise"""
    scaled: np.ndarray
    """r over the diagonal, likewise"""
    product: np.ndarray
    """the matrix times the search direction, likewise"""


def new_springs(springs: int, particles: int) -> Springs:
    """Return storage for so many springs and particles."""
    def vectors():
        return np.zeros((particles, 3))
    return Springs(np.zeros(1, np.int64), np.zeros((springs, 4), np.int64), np.zeros((springs, 4)),
                   np.zeros(springs), np.zeros(springs), np.zeros(particles), vectors(), vectors(),
                   vectors(), np.zeros(particles), vectors(), vectors(), vectors(), vectors())


@jit
def step_towards_balance(springs, count, components, small):
    """
    Solve for Δx and add it to x.

    Parameters
    ----------
    springs : the springs; ``missing`` and ``diagonal`` belong to x
    count : number of particles
    components : 1, or 3: those across the axis
    small : sum of the squares of r at which to stop

    """
    r, p, z, product, step = (springs.missing, springs.along, springs.scaled, springs.product,
                              springs.step)
    precondition(springs, count, components)
    for i in range(count):
        for a in range(components):
            step[i, a], p[i, a] = 0.0, z[i, a]
    before = dot(r, z, count, components)
    for _ in range(ITERATIONS):
        multiply(springs, count, components)
        curvature = dot(p, product, count, components)
        if not curvature > 0.0:
            break
        length = before / curvature
        for i in range(count):
            for a in range(components):
                step[i, a] += length * p[i, a]
                r[i, a] -= length * product[i, a]
        if dot(r, r, count, components) <= small:
            break
        precondition(springs, count, components)
        now = dot(r, z, count, components)
        share, before = now / before, now
        for i in range(count):
            for a in range(components):
                p[i, a] = z[i, a] + share * p[i, a]
    for i in range(count):
        for a in range(components):
            springs.x[i, a] += step[i, a]


@jit
def precondition(springs, count, components):
    """Divide r by the diagonal; fixed particles stay."""
    for i in range(count):
        per = 1.0 / springs.diagonal[i] if springs.mass[i] > 0.0 else 0.0
        for a in range(components):
            springs.scaled[i, a] = per * springs.missing[i, a]


@jit
def multiply(springs, count, components):
    """Write the product of the matrix and the search direction."""
    p, product = springs.along, springs.product
    for i in range(count):
        for a in range(components):
            product[i, a] = springs.mass[i] * p[i, a]
    for t in range(springs.count[0]):
        k = springs.acting[t]
        if k > 0.0:
            for a in range(components):
                add_force(springs, t, a, k * stretch(springs, t, p, a), product)
    free(springs, product, count, components)


@jit(inline=True)
def stretch(springs, t, x, a):
    """Return component a of Σ w x of spring t."""
    i, w = springs.ends[t], springs.weight[t]
    return w[0] * x[i[0], a] + w[1] * x[i[1], a] + w[2] * x[i[2], a] + w[3] * x[i[3], a]


@jit(inline=True)
def add_force(springs, t, a, force, forces):
    """Add component a of a spring's force, w times ``force``, to those on particles."""
    i, w = springs.ends[t], springs.weight[t]
    forces[i[0], a] += w[0] * force
    forces[i[1], a] += w[1] * force
    forces[i[2], a] += w[2] * force
    forces[i[3], a] += w[3] * force


@jit
def free(springs, forces, count, components):
    """Leave what moves particles: nothing moves fixed ones, and three components lack the axis."""
    for i in range(count):
        along, n = 0.0, springs.axis[i]
        if components == 3:
            along = n[0] * forces[i, 0] + n[1] * forces[i, 1] + n[2] * forces[i, 2]
        for a in range(components):
            forces[i, a] = forces[i, a] - along * n[a] if springs.mass[i] > 0.0 else 0.0


@jit
def dot(u, v, count, components):
    """Return the sum of the products of two vectors."""
    total = 0.0
    for i in range(count):
        for a in range(components):
            total += u[i, a] * v[i, a]
    return total


@jit
def begin_balance(springs, count, components):
    """Begin the sums of forces and of the diagonal with 0 and the mass."""
    for i in range(count):
        springs.diagonal[i] = springs.mass[i]
        for a in range(components):
            springs.missing[i, a] = 0.0


@jit(inline=True)
def add_to_diagonal(springs, t):
    """Add what spring t adds to the diagonal."""
    i, w, k = springs.ends[t], springs.weight[t], springs.acting[t]
    for e in range(4):
        springs.diagonal[i[e]] += k * w[e] * w[e]


@jit
def take_back_half(springs, count, components):
    """Halve the last step."""
    for i in range(count):
        for a in range(components):
            springs.step[i, a] *= 0.5
            springs.x[i, a] -= springs.step[i, a]
