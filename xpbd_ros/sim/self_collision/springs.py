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
    """number of springs, and of those that act; shape (2,)"""
    ends: np.ndarray
    """particles of each spring, uint32, shape (springs, 4)"""
    weight: np.ndarray
    """w, 0 for ends that are not used, shape (springs, 4)"""
    stiffness: np.ndarray
    """k where it acts [1 / mobility], shape (springs,)"""
    acting: np.ndarray
    """springs that act at present, uint32, shape (springs,)"""
    mass: np.ndarray
    """inverse of the mobility, 0 for fixed particles, shape (particles,)"""
    axis: np.ndarray
    """axis of each particle, shape (particles, 3)"""
    x: np.ndarray
    """displacements [m], shape (3, particles); one component is the first"""
    missing: np.ndarray
    """r, shape (3, particles)"""
    diagonal: np.ndarray
    """that of M + Σ k w wᵀ, shape (particles,)"""
    step: np.ndarray
    """Δx [m], shape (3, particles)"""
    along: np.ndarray
    """search direction, likewise"""
    scaled: np.ndarray
    """r over the diagonal, likewise"""
    product: np.ndarray
    """the matrix times the search direction, likewise"""


def new_springs(springs: int, particles: int) -> Springs:
    """Return storage for so many springs and particles."""
    def vectors():
        return np.zeros((3, particles))
    return Springs(np.zeros(2, np.int64), np.zeros((springs, 4), np.uint32),
                   np.zeros((springs, 4)), np.zeros(springs), np.zeros(springs, np.uint32),
                   np.zeros(particles), np.zeros((particles, 3)), vectors(), vectors(),
                   np.zeros(particles), vectors(), vectors(), vectors(), vectors())


@jit
def step_towards_balance(springs, count, components, small):
    """
    Solve for Δx and add it to x.

    Parameters
    ----------
    springs : the springs; ``acting``, ``missing`` and ``diagonal`` belong to x
    count : number of particles
    components : 1, or 3: those across the axis
    small : sum of the squares of r at which to stop

    """
    r, p, z, product, step = (springs.missing, springs.along, springs.scaled, springs.product,
                              springs.step)
    precondition(springs, count, components)
    for a in range(components):
        for i in range(count):
            step[a, i], p[a, i] = 0.0, z[a, i]
    before = dot(r, z, count, components)
    for _ in range(ITERATIONS):
        multiply(springs, count, components)
        curvature = dot(p, product, count, components)
        if not curvature > 0.0:
            break
        length = before / curvature
        for a in range(components):
            for i in range(count):
                step[a, i] += length * p[a, i]
                r[a, i] -= length * product[a, i]
        if dot(r, r, count, components) <= small:
            break
        precondition(springs, count, components)
        now = dot(r, z, count, components)
        share, before = now / before, now
        for a in range(components):
            for i in range(count):
                p[a, i] = z[a, i] + share * p[a, i]
    for a in range(components):
        for i in range(count):
            springs.x[a, i] += step[a, i]


@jit
def precondition(springs, count, components):
    """Divide r by the diagonal; fixed particles stay."""
    for a in range(components):
        for i in range(count):
            moves = springs.mass[i] > 0.0
            springs.scaled[a, i] = springs.missing[a, i] / springs.diagonal[i] if moves else 0.0


@jit
def multiply(springs, count, components):
    """Write the product of the matrix and the search direction."""
    for a in range(components):
        p, product = springs.along[a], springs.product[a]
        for i in range(count):
            product[i] = springs.mass[i] * p[i]
        for m in range(springs.count[1]):
            t = springs.acting[m]
            add_force(springs, t, springs.stiffness[t] * stretch(springs, t, p), product)
    free(springs, springs.product, count, components)


@jit(inline=True)
def stretch(springs, t, x):
    """Return Σ w x of spring t, of one component."""
    i, w = springs.ends[t], springs.weight[t]
    return w[0] * x[i[0]] + w[1] * x[i[1]] + w[2] * x[i[2]] + w[3] * x[i[3]]


@jit(inline=True)
def add_force(springs, t, force, forces):
    """Add a spring's force, w times ``force``, to those on particles, of one component."""
    i, w = springs.ends[t], springs.weight[t]
    forces[i[0]] += w[0] * force
    forces[i[1]] += w[1] * force
    forces[i[2]] += w[2] * force
    forces[i[3]] += w[3] * force


@jit
def free(springs, forces, count, components):
    """Leave what moves particles: nothing moves fixed ones, and three components lack the axis."""
    for i in range(count):
        along, n = 0.0, springs.axis[i]
        if components == 3:
            along = n[0] * forces[0, i] + n[1] * forces[1, i] + n[2] * forces[2, i]
        for a in range(components):
            forces[a, i] = forces[a, i] - along * n[a] if springs.mass[i] > 0.0 else 0.0


@jit
def dot(u, v, count, components):
    """Return the sum of the products of two vectors."""
    total = 0.0
    for a in range(components):
        for i in range(count):
            total += u[a, i] * v[a, i]
    return total


@jit
def begin_balance(springs, count, components):
    """Begin the sums of forces and of the diagonal with 0 and the mass; no spring acts."""
    springs.count[1] = 0
    for i in range(count):
        springs.diagonal[i] = springs.mass[i]
    for a in range(components):
        for i in range(count):
            springs.missing[a, i] = 0.0


@jit(inline=True)
def let_act(springs, t):
    """Let spring t act."""
    i, w, k = springs.ends[t], springs.weight[t], springs.stiffness[t]
    springs.acting[springs.count[1]] = t
    springs.count[1] += 1
    for e in range(4):
        springs.diagonal[i[e]] += k * w[e] * w[e]


@jit
def take_back_half(springs, count):
    """Halve the last step of one component."""
    for i in range(count):
        springs.step[0, i] *= 0.5
        springs.x[0, i] -= springs.step[0, i]
