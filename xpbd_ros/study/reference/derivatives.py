"""
Automatic differentiation: numbers with exact first and second derivatives.

A formula evaluated with plain arrays gives its value; evaluated with jets, it also gives gradient
and Hessian. For u and v with derivatives u', u'' and v', v'',

    (u v)' = u v' + v u',   (u v)'' = u v'' + v u'' + u' v'ᵀ + v' u'ᵀ,
    f(u)'' = f' u'' + f'' u' u'ᵀ.
"""

import numpy as np


class Jet:
    """
    Values with derivatives with respect to q variables.

    Parameters
    ----------
    value : shape (m,)
    first : gradients, shape (m, q)
    second : Hessians, shape (m, q, q), or 0; None if they are not computed
    """

    __array_ufunc__ = None    # makes array * jet call Jet.__rmul__

    def __init__(self, value, first, second):
        self.value, self.first, self.second = value, first, second

    def __add__(self, other):
        """Return u + v."""
        if isinstance(other, Jet):
            second = None if self.second is None else self.second + other.second
            return Jet(self.value + other.value, self.first + other.first, second)
        return Jet(self.value + other, self.first, self.second)

    def __mul__(self, other):
        """Return u v."""
        if isinstance(other, Jet):
            return of_two(self, other, self.value * other.value, other.value, self.value,
                          0.0, 1.0, 0.0)
        second = None if self.second is None else _by_row(other, 2) * self.second
        return Jet(self.value * other, _by_row(other, 1) * self.first, second)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self):
        """Return -u."""
        return -1.0 * self

    def __sub__(self, other):
        """Return u - v."""
        return self + -1.0 * other


def _by_row(factor, more: int):
    """Return factors, shape (m,), with ``more`` axes appended; scalars unchanged."""
    return np.reshape(factor, np.shape(factor) + (1,) * more) if np.ndim(factor) else factor


def of_two(u: Jet, v: Jet, value, by_u, by_v, by_uu, by_uv, by_vv) -> Jet:
    """Return the jet of f(u, v), given the value and the partial derivatives of f."""
    first = _by_row(by_u, 1) * u.first + _by_row(by_v, 1) * v.first
    if u.second is None:
        return Jet(value, first, None)
    across = u.first[:, :, None] * v.first[:, None, :]
    second = (_by_row(by_u, 2) * u.second + _by_row(by_v, 2) * v.second
              + _by_row(by_uv, 2) * (across + across.swapaxes(1, 2)))
    for w, twice in ((u, by_uu), (v, by_vv)):
        if np.ndim(twice):
            second = second + _squared(w, twice)
    return Jet(value, first, second)


def _squared(u: Jet, by: np.ndarray) -> np.ndarray:
    """Return ``by`` u' u'ᵀ, shape (m, q, q)."""
    return (by[:, None] * u.first)[:, :, None] * u.first[:, None, :]


def variables(z: np.ndarray, order: int) -> list:
    """Return the columns of z, shape (m, q), as arrays (order 0) or as jets of order 1 or 2."""
    if order == 0:
        return list(z.T)
    unit = np.eye(z.shape[1])[:, None]
    return [Jet(values, row, 0.0 if order == 2 else None) for values, row in zip(z.T, unit)]


def root(u):
    """Return √u, with zero derivatives where u is 0."""
    if not isinstance(u, Jet):
        return np.sqrt(u)
    value = np.sqrt(u.value)
    once = np.divide(0.5, value, out=np.zeros_like(value), where=value > 0.0)
    if u.second is None:
        return Jet(value, once[:, None] * u.first, None)
    twice = np.divide(-0.5 * once, u.value, out=np.zeros_like(value), where=value > 0.0)
    return Jet(value, once[:, None] * u.first, _by_row(once, 2) * u.second + _squared(u, twice))


def angle(y, x):
    """Return atan2(y, x) [rad], with zero derivatives where both are 0."""
    if not isinstance(y, Jet):
        return np.arctan2(y, x)
    square = y.value**2 + x.value**2
    per = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0.0)
    b, a = y.value * per, x.value * per
    return of_two(y, x, np.arctan2(y.value, x.value), a, -b, -2.0 * a * b, b * b - a * a,
                  2.0 * a * b)


def wrapped(u):
    """Return an angle reduced by whole turns to [-π, π] [rad]."""
    value = u.value if isinstance(u, Jet) else u
    return u - 2.0 * np.pi * np.round(value / (2.0 * np.pi))


def dot(u, v):
    """Return u·v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u, v):
    """Return u × v."""
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
