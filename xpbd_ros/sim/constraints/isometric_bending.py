"""Isometric bending of hinges (Bergou et al. 2006): weights of the rest shape, projection."""

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import fma, lanes, load, select
from xpbd_ros.sim.backend.simd_records import load_records
from xpbd_ros.sim.constraints.projection import denominator, keep, recall, xpbd_residual
from xpbd_ros.sim.geometry.mesh import cross, dot, length
from xpbd_ros.sim.particles.records import put_records


def isometric_weights(corners: np.ndarray) -> np.ndarray:
    """
    Return the weights k_i = K_i / sqrt(A0 + A1) of C = Σ k_i x_i [1/m], shape (hinges, 4).

    Parameters
    ----------
    corners : rest positions of the hinges' particles [m], shape (hinges, 4, 3)

    """
    x0, x1, x2, x3 = (corners[:, k] for k in range(4))
    e = x1 - x0

    def cot(u, v):
        return dot(u, v) / length(cross(u, v))

    c01, c02, c03, c04 = cot(e, x2 - x0), cot(e, x3 - x0), cot(-e, x2 - x1), cot(-e, x3 - x1)
    area = 0.5 * (length(cross(e, x2 - x0)) + length(cross(e, x3 - x0)))
    return np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], 1) / np.sqrt(area)[:, None]


@jit
def project_packs(records, apart, particles, weight, compliance, fx, fy, fz, reverse):
    """Project C = Σ k_i x_i of all hinges, pack by pack (formulas in ``bend``)."""
    count, step = len(compliance), lanes(compliance)
    p0, p1, p2, p3 = particles[0], particles[1], particles[2], particles[3]
    w0, w1, w2, w3 = weight[0], weight[1], weight[2], weight[3]
    for p in range(0, count, step):
        q = count - step - p if reverse else p
        x0, y0, z0, m0 = load_records(records, p0, q)
        x1, y1, z1, m1 = load_records(records, p1, q)
        x2, y2, z2, m2 = load_records(records, p2, q)
        x3, y3, z3, m3 = load_records(records, p3, q)
        k0, k1, k2, k3 = load(w0, q), load(w1, q), load(w2, q), load(w3, q)
        n0, n1, n2, n3 = k0 * m0, k1 * m1, k2 * m2, k3 * m3
        total = fma(k0, n0, fma(k1, n1, fma(k2, n2, k3 * n3)))
        alpha = load(compliance, q)
        f, g, h = recall(apart, fx, q), recall(apart, fy, q), recall(apart, fz, q)
        x = fma(k0, x0, fma(k1, x1, fma(k2, x2, k3 * x3)))
        y = fma(k0, y0, fma(k1, y1, fma(k2, y2, k3 * y3)))
        z = fma(k0, z0, fma(k1, z1, fma(k2, z2, k3 * z3)))
        per = select(total > 0.0, -1.0 / denominator(apart, total, alpha), 0.0)
        dx, dy, dz = (per * xpbd_residual(x, alpha, f), per * xpbd_residual(y, alpha, g),
                      per * xpbd_residual(z, alpha, h))
        keep(fx, q, f, dx)
        keep(fy, q, g, dy)
        keep(fz, q, h, dz)
        put_records(records, apart, p0, q, x0, y0, z0, m0, n0, dx, dy, dz)
        put_records(records, apart, p1, q, x1, y1, z1, m1, n1, dx, dy, dz)
        put_records(records, apart, p2, q, x2, y2, z2, m2, n2, dx, dy, dz)
        put_records(records, apart, p3, q, x3, y3, z3, m3, n3, dx, dy, dz)
