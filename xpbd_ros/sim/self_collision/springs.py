"""
Linear springs between particles with inertia, and their equilibrium by conjugate gradients.

Spring t has the elongation Σ w x, with up to four particles and weights w, and the stiffness k.
With the residual r of the forces at the displacements x, a step of Newton's method solves

    (M + Σ k w wᵀ) Δx = r

by conjugate gradients with the diagonal as the preconditioner (Hestenes and Stiefel 1952), for one
component, or for the two across an axis of each particle. One thread does this: particles between
pads are few.
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit

ITERATIONS = 80
"""most steps of one solve"""


class Springs(NamedTuple):
    """Springs, particles in an order of their own, and the vectors of the solver."""

    count: np.ndarray
    """number of springs, and of active ones; shape (2,), by island (islands, 2)"""
    ends: np.ndarray
    """particles of each spring, uint32, shape (springs, 4)"""
    weight: np.ndarray
    """w, 0 for ends that are not used, shape (springs, 4)"""
    stiffness: np.ndarray
    """k [1 / mobility], shape (springs,)"""
    active: np.ndarray
    """indices of the springs that act at x, uint32, shape (springs,)"""
    mass: np.ndarray
    """inverse of the mobility, 0 for fixed particles, shape (particles,)"""
    axis: np.ndarray
    """axis of each particle, shape (particles, 3)"""
    x: np.ndarray
    """
    displacements [m], one component after the other: that of particle i at a count + i, if there
    are ``count`` particles; shape (3 particles,)
    """
    residual: np.ndarray
    """r, likewise"""
    diagonal: np.ndarray
    """that of M + Σ k w wᵀ, shape (particles,)"""
    step: np.ndarray
    """Δx [m], shape (3, particles)"""
    direction: np.ndarray
    """search direction, likewise"""
    preconditioned: np.ndarray
    """r over the diagonal, likewise"""
    product: np.ndarray
    """the matrix times the search direction, likewise"""


def new_springs(springs: int, particles: int) -> Springs:
    """Return storage for so many springs and particles."""
    def vectors():
        return np.zeros(3 * particles)
    return Springs(np.zeros((particles, 2), np.int64), np.zeros((springs, 4), np.uint32),
                   np.zeros((springs, 4)), np.zeros(springs), np.zeros(springs, np.uint32),
                   np.zeros(particles), np.zeros((particles, 3)), vectors(), vectors(),
                   np.zeros(particles), vectors(), vectors(), vectors(), vectors())


@jit
def conjugate_gradients(springs, count, components, small):
    """
    Solve for Δx and add it to x.

    Parameters
    ----------
    springs : the springs, with the residual, the diagonal and the active springs at x
    count : number of particles
    components : 1, or 3: those across the axis
    small : squared norm of r at which to stop

    """
    r, p, z, product, step = (springs.residual, springs.direction, springs.preconditioned,
                              springs.product, springs.step)
    size = components * count
    precondition(springs, count, components)
    for i in range(size):
        step[i], p[i] = 0.0, z[i]
    before = dot(r, z, size)
    for _ in range(ITERATIONS):
        multiply(springs, count, components)
        curvature = dot(p, product, size)
        if not curvature > 0.0:
            break
        length = before / curvature
        for i in range(size):
            step[i] += length * p[i]
            r[i] -= length * product[i]
        if dot(r, r, size) <= small:
            break
        precondition(springs, count, components)
        now = dot(r, z, size)
        share, before = now / before, now
        for i in range(size):
            p[i] = z[i] + share * p[i]
    for i in range(size):
        springs.x[i] += step[i]


@jit
def precondition(springs, count, components):
    """Divide r by the diagonal; fixed particles stay."""
    r, z = springs.residual, springs.preconditioned
    for a in range(components):
        for i in range(count):
            k = a * count + i
            z[k] = r[k] / springs.diagonal[i] if springs.mass[i] > 0.0 else 0.0


@jit
def multiply(springs, count, components):
    """Write the product of the matrix and the search direction."""
    p, product = springs.direction, springs.product
    for a in range(components):
        for i in range(count):
            product[a * count + i] = springs.mass[i] * p[a * count + i]
        for m in range(springs.count[1]):
            t = springs.active[m]
            add_force(springs, t, springs.stiffness[t] * elongation(springs, t, p, a * count),
                      product, a * count)
    constrain(springs, product, count, components)


@jit(inline=True)
def elongation(springs, t, x, first):
    """Return Σ w x of spring t, of the component that begins at ``first``."""
    i, w = springs.ends[t], springs.weight[t]
    return (w[0] * x[first + i[0]] + w[1] * x[first + i[1]] + w[2] * x[first + i[2]]
            + w[3] * x[first + i[3]])


@jit(inline=True)
def add_force(springs, t, force, forces, first):
    """Add a spring's force, w times ``force``, to the component that begins at ``first``."""
    i, w = springs.ends[t], springs.weight[t]
    forces[first + i[0]] += w[0] * force
    forces[first + i[1]] += w[1] * force
    forces[first + i[2]] += w[2] * force
    forces[first + i[3]] += w[3] * force


@jit
def constrain(springs, forces, count, components):
    """Remove forces on fixed particles, and of three components the part along the axis."""
    for i in range(count):
        along, n = 0.0, springs.axis[i]
        if components == 3:
            along = (n[0] * forces[i] + n[1] * forces[count + i]
                     + n[2] * forces[2 * count + i])
        for a in range(components):
            k = a * count + i
            forces[k] = forces[k] - along * n[a] if springs.mass[i] > 0.0 else 0.0


@jit
def dot(u, v, size):
    """Return the sum of the products of the first ``size`` numbers of two vectors."""
    total = 0.0
    for i in range(size):
        total += u[i] * v[i]
    return total


@jit
def begin_residual(springs, count, components):
    """Set r to 0 and the diagonal to the mass, without active springs."""
    springs.count[1] = 0
    for i in range(count):
        springs.diagonal[i] = springs.mass[i]
    for i in range(components * count):
        springs.residual[i] = 0.0


@jit(inline=True)
def activate(springs, t):
    """Add spring t to the active ones and to the diagonal."""
    i, w, k = springs.ends[t], springs.weight[t], springs.stiffness[t]
    springs.active[springs.count[1]] = t
    springs.count[1] += 1
    for e in range(4):
        springs.diagonal[i[e]] += k * w[e] * w[e]


@jit
def halve_step(springs, count):
    """Take back half of the last step of one component."""
    for i in range(count):
        springs.step[i] *= 0.5
        springs.x[i] -= springs.step[i]
