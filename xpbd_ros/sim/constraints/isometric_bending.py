"""Isometric bending of hinges (Bergou et al. 2006): weights of the rest shape."""

import numpy as np

from xpbd_ros.sim.geometry.mesh import cross, dot, length


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
