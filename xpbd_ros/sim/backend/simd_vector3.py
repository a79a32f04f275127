"""
Vectors of R³ in SIMD lanes: positions, gradients and normals as one value.

    n = cross(b - a, c - a)
    area = 0.5 * length(n)

A ``Vector3`` has three vectors of lanes, x, y and z, one point of R³ in each lane. Sums, products
with scalars, ``dot``, ``cross`` and ``fma`` work on all lanes, by the operations that their
docstrings say, so results have the same bits as those written out by components.
"""

import operator

from numba import types
from numba.core import cgutils
from numba.extending import (
    intrinsic,
    lower_builtin,
    make_attribute_wrapper,
    models,
    register_model,
    type_callable,
)
import numpy as np

from xpbd_ros.sim.backend.simd import call_intrinsic, Vector, widened

AXES = 'xyz'


class Vector3(types.Type):
    """Three vectors of lanes."""

    def __init__(self, vector):
        self.vector = vector
        super().__init__(name=f'Vector3({vector})')


@register_model(Vector3)
class _Vector3Model(models.StructModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, [(axis, kind.vector) for axis in AXES])


for _axis in AXES:
    make_attribute_wrapper(Vector3, _axis, _axis)


def _made(context, builder, kind, components):
    found = cgutils.create_struct_proxy(kind)(context, builder)
    for axis, component in zip(AXES, components):
        setattr(found, axis, component)
    return found._getvalue()


def _components(builder, value):
    return [builder.extract_value(value, k) for k in range(len(AXES))]


def _dot(builder, vector, a, b):
    (ax, ay, az), (bx, by, bz) = a, b
    found = builder.fmul(az, bz)
    for one, other in ((ay, by), (ax, bx)):
        found = call_intrinsic(builder, 'fma', vector, [one, other, found])
    return found


@intrinsic
def vector3(typing, x, y, z):
    """Return the Vector3 of three vectors of lanes; some may be scalars."""
    vector = next(v for v in (x, y, z) if isinstance(v, Vector))
    kind = Vector3(vector)

    def generate(context, builder, signature, arguments):
        return _made(context, builder, kind, [widened(context, builder, v, k, vector)
                                              for v, k in zip(arguments, signature.args)])
    return kind(x, y, z), generate


def dot(a, b):
    """Return a·b along the last axis; in kernels of Vector3, fma(ax, bx, fma(ay, by, az bz))."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def length(a):
    """Return |a| along the last axis; in kernels of a Vector3, the root of ``dot(a, a)``."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    return np.sqrt(x * x + y * y + z * z)


def cross(a, b):
    """Return a × b along the last axis; in kernels of Vector3; components as ay bz - az by."""
    return np.stack([a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
                     a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
                     a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], -1)


def fused_cross(a, b):
    """Return a × b in kernels, of Vector3; components as fma(ay, bz, -az by)."""


def _vector3_or_none(kind):
    return kind if isinstance(kind, Vector3) else None


type_callable(dot)(lambda typing: lambda a, b: a.vector if _vector3_or_none(a) else None)
type_callable(length)(lambda typing: lambda a: a.vector if _vector3_or_none(a) else None)
type_callable(cross)(lambda typing: lambda a, b: _vector3_or_none(a))
type_callable(fused_cross)(lambda typing: lambda a, b: _vector3_or_none(a))


@lower_builtin(dot, Vector3, Vector3)
def _lower_dot(context, builder, signature, arguments):
    return _dot(builder, signature.return_type, *(_components(builder, a) for a in arguments))


@lower_builtin(length, Vector3)
def _lower_length(context, builder, signature, arguments):
    vector, own = signature.return_type, _components(builder, arguments[0])
    return call_intrinsic(builder, 'sqrt', vector, [_dot(builder, vector, own, own)])


def _crossed(fused):
    def lower(context, builder, signature, arguments):
        a, b = (_components(builder, each) for each in arguments)
        found = []
        for n, o in ((1, 2), (2, 0), (0, 1)):
            one, other = [a[n], b[o]], builder.fmul(a[o], b[n])
            found.append(call_intrinsic(builder, 'fma', signature.return_type.vector,
                                    [*one, builder.fneg(other)]) if fused else
                         builder.fsub(builder.fmul(*one), other))
        return _made(context, builder, signature.return_type, found)
    return lower


lower_builtin(cross, Vector3, Vector3)(_crossed(False))
lower_builtin(fused_cross, Vector3, Vector3)(_crossed(True))


@intrinsic
def fma3(typing, a, b, c):
    """Return a b + c for a scalar a and Vector3 b and c, each component rounded once."""
    def generate(context, builder, signature, arguments):
        vector = c.vector
        scale = widened(context, builder, arguments[0], signature.args[0], vector)
        return _made(context, builder, c, [
            call_intrinsic(builder, 'fma', vector, [scale, one, other])
            for one, other in zip(*(_components(builder, each) for each in arguments[1:]))])
    return c(a, b, c), generate


@intrinsic
def lane_of(typing, a, lane):
    """Return the number in one lane of a vector."""
    def generate(context, builder, signature, arguments):
        return builder.extract_element(*arguments)
    return a.lane(a, types.intp), generate


def _sum(operation, name):
    type_callable(operation)(lambda typing: lambda a, b: a if isinstance(
        a, Vector3) and a == b else None)

    @lower_builtin(operation, Vector3, Vector3)
    def lower(context, builder, signature, arguments):
        return _made(context, builder, signature.return_type, [
            getattr(builder, name)(a, b)
            for a, b in zip(*(_components(builder, each) for each in arguments))])


_sum(operator.add, 'fadd')
_sum(operator.sub, 'fsub')


def _product(a, b):
    if isinstance(a, Vector3) and isinstance(b, (Vector, types.Number)):
        return a
    if isinstance(b, Vector3) and isinstance(a, (Vector, types.Number)):
        return b


def _lower_product(context, builder, signature, arguments):
    kind = signature.return_type
    of, by = (0, 1) if isinstance(signature.args[0], Vector3) else (1, 0)
    scale = widened(context, builder, arguments[by], signature.args[by], kind.vector)
    return _made(context, builder, kind, [
        builder.fmul(each, scale) for each in _components(builder, arguments[of])])


type_callable(operator.mul)(lambda typing: _product)
for _kinds in ((Vector3, Vector), (Vector3, types.Number), (Vector, Vector3),
               (types.Number, Vector3)):
    lower_builtin(operator.mul, *_kinds)(_lower_product)

type_callable(operator.neg)(lambda typing: lambda a: a if isinstance(a, Vector3) else None)


@lower_builtin(operator.neg, Vector3)
def _negative(context, builder, signature, arguments):
    return _made(context, builder, signature.return_type, [
        builder.fneg(each) for each in _components(builder, arguments[0])])
