"""Constraints one by one as NumPy arrays: the definitions that kernels are tested against."""

from dataclasses import dataclass, fields
from math import inf
from typing import Any, TypeVar

import numpy as np

from xpbd_ros.sim.constraints.grid_batches import listed

C = TypeVar('C', bound='Constraints')


@dataclass(eq=False)
class Constraints:
    """
    Constraints in sweep order.

    A kind defines ``residual(x)``, where x is (3, slots), and ``stiffness_bound(x)``. Its further
    fields have the names and the dimensions of those of its batch, with the constraints first.
    """

    particles: np.ndarray
    """slots, shape (constraints, particles of each)"""
    index: np.ndarray
    """position of each multiplier in ``force``, shape (constraints,)"""
    compliance: np.ndarray
    """α, shape (constraints,), or (constraints, components)"""

    @classmethod
    def of(cls: type[C], batch: Any) -> C:
        """Return the constraints of a batch."""
        names = [field.name for field in fields(cls)[2:]]
        if 'runs' in batch._fields:
            particles, index, shape, place = listed(batch.runs)
            return cls(particles, index, *(
                batch.compliance[shape, place].astype(float) if name == 'compliance' else
                getattr(batch, name)[shape].astype(float) for name in names))
        index = np.flatnonzero(batch.particles[0] != batch.particles[1])
        return cls(batch.particles[:, index].T.astype(np.int64), index, *(
            getattr(batch, name)[..., index].T.astype(float) for name in names))

    @classmethod
    def joined(cls: type[C], lists: list) -> C:
        """Return the constraints of several batches; ``index`` refers to each one's own batch."""
        return cls(*(np.concatenate([getattr(these, field.name) for these in lists])
                     for field in fields(cls)))

    def corners(self, x: np.ndarray) -> np.ndarray:
        """Return the positions of the particles [m], shape (constraints, particles of each, 3)."""
        return x.T.astype(float)[self.particles]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return C from its definition, shape (constraints,), or (constraints, components)."""
        raise NotImplementedError

    def stiffness_bound(self, x: np.ndarray) -> np.ndarray:
        """Return an upper bound of the stiffness K at each particle [N/m], shape (slots, 3, 3)."""
        raise NotImplementedError

    def rate(self, mass: np.ndarray) -> float:
        """Return the largest of bounds that have no direction, over mass [1/s²]."""
        if (self.compliance == 0.0).any():
            return inf
        there = mass > 0.0
        with np.errstate(over='ignore'):
            bound = self.stiffness_bound(np.zeros((3, len(mass))))[there, 0, 0]
            return float((bound / mass[there]).max(initial=0.0))

    def energy(self, x: np.ndarray) -> float:
        """Return Σ |C|² / (2 α) [J]; a rigid constraint stores none."""
        residual, alpha = self.residual(x), self.compliance
        if residual.ndim > alpha.ndim:
            alpha = alpha[:, None]
        alpha = np.broadcast_to(alpha, residual.shape)
        elastic = alpha > 0.0
        return float((0.5 * residual[elastic]**2 / alpha[elastic]).sum())


def isotropic(x: np.ndarray, particles: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """
    Return sums at each particle of stiffnesses in all directions, shape (slots, 3, 3).

    Parameters
    ----------
    x : positions, shape (3, slots)
    particles : slots, of any shape
    stiffness : at each of them [N/m], of that shape or to be broadcast to it

    """
    stiffness = np.broadcast_to(stiffness, particles.shape)
    total = np.bincount(particles.ravel(), stiffness.ravel(), x.shape[1])
    return total[:, None, None] * np.eye(3)
