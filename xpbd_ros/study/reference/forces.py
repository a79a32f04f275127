"""
Forces of each kind of element for leapfrog, with gradients derived by hand.

They follow doc/numerics.md 5, independently of the formulas of ``elements``, against which they
are tested. A position is x + low, where ``low`` is the rounding error of x. Each kernel adds
-∇E [N] to ``f``.
"""

from collections.abc import Callable
from math import atan2, pi, sqrt

from numba import njit
import numpy as np

from xpbd_ros.study.reference.elements import (
    Areas,
    Edges,
    Gas,
    Hinges,
    LinearSums,
    Membranes,
    Slants,
    Tetrahedra,
)

fast = njit(nogil=True, error_model='numpy')
small = njit(nogil=True, error_model='numpy', inline='always')


@small
def _edge(x, low, i, j):
    """Return the vector from particle i to particle j [m]."""
    return (x[j, 0] - x[i, 0] + (low[j, 0] - low[i, 0]),
            x[j, 1] - x[i, 1] + (low[j, 1] - low[i, 1]),
            x[j, 2] - x[i, 2] + (low[j, 2] - low[i, 2]))


@small
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@small
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@fast
def edge_forces(x, low, f, particles, rest_length, stiffness):
    for e in range(len(particles)):
        i, j = particles[e, 0], particles[e, 1]
        d = _edge(x, low, i, j)
        l = sqrt(_dot(d, d))
        if l == 0.0:
            continue
        tension = stiffness[e] * (l - rest_length[e]) / l
        for k in range(3):
            f[i, k] += tension * d[k]
            f[j, k] -= tension * d[k]


@fast
def slant_forces(x, low, f, particles, stiffness):
    for c in range(len(particles)):
        i0, i1, i2, i3 = particles[c]
        d, e = _edge(x, low, i0, i1), _edge(x, low, i2, i3)
        l, g = sqrt(_dot(d, d)), sqrt(_dot(e, e))
        if l == 0.0 or g == 0.0:
            continue
        tension = stiffness[c] * (l - g)
        for k in range(3):
            f[i0, k] += tension * d[k] / l
            f[i1, k] -= tension * d[k] / l
            f[i2, k] -= tension * e[k] / g
            f[i3, k] += tension * e[k] / g


@fast
def sum_forces(x, low, f, particles, weight, stiffness):
    for h in range(len(particles)):
        first = particles[h, 0]
        for k in range(3):
            moment = 0.0
            for p in range(particles.shape[1]):
                i = particles[h, p]
                moment += weight[h, p] * (x[i, k] - x[first, k] + (low[i, k] - low[first, k]))
            for p in range(particles.shape[1]):
                f[particles[h, p], k] -= stiffness[h] * weight[h, p] * moment


@fast
def membrane_forces(x, low, f, particles, inverse, moduli):
    for t in range(len(particles)):
        i0, i1, i2 = particles[t]
        d, e = _edge(x, low, i0, i1), _edge(x, low, i0, i2)
        p1, q1, p2, q2 = inverse[t, 0, 0], inverse[t, 0, 1], inverse[t, 1, 0], inverse[t, 1, 1]
        c = (p1 * d[0] + p2 * e[0], p1 * d[1] + p2 * e[1], p1 * d[2] + p2 * e[2])
        g = (q1 * d[0] + q2 * e[0], q1 * d[1] + q2 * e[1], q1 * d[2] + q2 * e[2])
        e11, e22, e12 = 0.5 * (_dot(c, c) - 1.0), 0.5 * (_dot(g, g) - 1.0), _dot(c, g)
        s = moduli[t]
        s1 = s[0, 0] * e11 + s[0, 1] * e22 + s[0, 2] * e12
        s2 = s[1, 0] * e11 + s[1, 1] * e22 + s[1, 2] * e12
        s3 = s[2, 0] * e11 + s[2, 1] * e22 + s[2, 2] * e12
        for k in range(3):
            along, across = s1 * c[k] + s3 * g[k], s2 * g[k] + s3 * c[k]
            one, two = p1 * along + q1 * across, p2 * along + q2 * across
            f[i0, k] += one + two
            f[i1, k] -= one
            f[i2, k] -= two


@fast
def hinge_forces(x, low, f, particles, rest_angle, stiffness):
    for h in range(len(particles)):
        i0, i1, i2, i3 = particles[h]
        e, a, b = _edge(x, low, i0, i1), _edge(x, low, i0, i2), _edge(x, low, i0, i3)
        n, o = _cross(e, a), _cross(b, e)
        l, nn, oo = sqrt(_dot(e, e)), _dot(n, n), _dot(o, o)
        if nn == 0.0 or oo == 0.0:
            continue
        turn = atan2(_dot(_cross(n, o), e) / l, _dot(n, o)) - rest_angle[h]
        turn -= 2.0 * pi * np.round(turn / (2.0 * pi))
        s, t = _dot(a, e) / (l * nn), _dot(b, e) / (l * oo)
        moment = -stiffness[h] * turn
        for k in range(3):
            g2, g3 = -l / nn * n[k], -l / oo * o[k]
            g1 = s * n[k] + t * o[k]
            f[i0, k] -= moment * (g1 + g2 + g3)
            f[i1, k] += moment * g1
            f[i2, k] += moment * g2
            f[i3, k] += moment * g3


@fast
def area_forces(x, low, f, particles, rest_area, stiffness):
    for t in range(len(particles)):
        i0, i1, i2 = particles[t]
        a, b = _edge(x, low, i0, i1), _edge(x, low, i0, i2)
        n = _cross(a, b)
        twice = sqrt(_dot(n, n))
        if twice == 0.0:
            continue
        pull = -stiffness[t] * (0.5 * twice - rest_area[t]) * 0.5 / twice
        g, h = _cross(b, n), _cross(n, a)
        for k in range(3):
            f[i0, k] -= pull * (g[k] + h[k])
            f[i1, k] += pull * g[k]
            f[i2, k] += pull * h[k]


@fast
def tetrahedron_forces(x, low, f, particles, inverse, shear, bulk):
    for t in range(len(particles)):
        i0, i1, i2, i3 = particles[t]
        a, b, c = _edge(x, low, i0, i1), _edge(x, low, i0, i2), _edge(x, low, i0, i3)
        m = inverse[t]
        u = (a[0] * m[0, 0] + b[0] * m[1, 0] + c[0] * m[2, 0],
             a[1] * m[0, 0] + b[1] * m[1, 0] + c[1] * m[2, 0],
             a[2] * m[0, 0] + b[2] * m[1, 0] + c[2] * m[2, 0])
        v = (a[0] * m[0, 1] + b[0] * m[1, 1] + c[0] * m[2, 1],
             a[1] * m[0, 1] + b[1] * m[1, 1] + c[1] * m[2, 1],
             a[2] * m[0, 1] + b[2] * m[1, 1] + c[2] * m[2, 1])
        w = (a[0] * m[0, 2] + b[0] * m[1, 2] + c[0] * m[2, 2],
             a[1] * m[0, 2] + b[1] * m[1, 2] + c[1] * m[2, 2],
             a[2] * m[0, 2] + b[2] * m[1, 2] + c[2] * m[2, 2])
        vw, wu, uv = _cross(v, w), _cross(w, u), _cross(u, v)
        swell = (bulk[t] + 8.0 / 9.0 * shear[t]) * (_dot(u, vw) - 1.0) - shear[t]
        norm = sqrt(_dot(u, u) + _dot(v, v) + _dot(w, w))
        draw = shear[t]
        if norm > 0.0:
            draw *= 1.0 + (1.0 - sqrt(3.0) / norm) / 3.0
        for k in range(3):
            p, q, r = (draw * u[k] + swell * vw[k], draw * v[k] + swell * wu[k],
                       draw * w[k] + swell * uv[k])
            one = p * m[0, 0] + q * m[0, 1] + r * m[0, 2]
            two = p * m[1, 0] + q * m[1, 1] + r * m[1, 2]
            three = p * m[2, 0] + q * m[2, 1] + r * m[2, 2]
            f[i0, k] += one + two + three
            f[i1, k] -= one
            f[i2, k] -= two
            f[i3, k] -= three


@fast
def gas_forces(x, low, f, particles, rest_volume, compliance):
    origin = particles[0, 0]
    six = 0.0
    for t in range(len(particles)):
        i, j, k = particles[t]
        six += _dot(_edge(x, low, origin, i), _cross(_edge(x, low, origin, j),
                                                     _edge(x, low, origin, k)))
    push = -(six / 6.0 - rest_volume) / compliance / 6.0
    for t in range(len(particles)):
        i, j, k = particles[t]
        a, b, c = (_edge(x, low, origin, i), _edge(x, low, origin, j), _edge(x, low, origin, k))
        bc, ca, ab = _cross(b, c), _cross(c, a), _cross(a, b)
        for m in range(3):
            f[i, m] += push * bc[m]
            f[j, m] += push * ca[m]
            f[k, m] += push * ab[m]


FORCE_KERNELS: dict[type, Callable[..., None]] = {
    Edges: edge_forces, Slants: slant_forces, LinearSums: sum_forces, Membranes: membrane_forces,
    Hinges: hinge_forces, Areas: area_forces, Tetrahedra: tetrahedron_forces, Gas: gas_forces}
"""kernel(x, low, f, particles, *parameters) by kind of element"""
