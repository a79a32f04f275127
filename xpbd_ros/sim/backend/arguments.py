"""
Contiguous arrays in this package's named tuples are passed to kernels as an address and a shape.

Numba passes an array as two owners, two sizes, an address, a shape and strides, each number an
argument of its own, and a tuple as all that it holds. For the state and the effects of a scene
that makes hundreds of arguments of every call, and most of the instructions that LLVM reads.
Strides and sizes of a contiguous array follow from its shape. Its owners are null within a kernel,
so a kernel must not return to Python an array that it got in a named tuple.
"""

from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.np.numpy_support import as_dtype

PACKAGE = __name__.partition('.')[0]


class CompactTuple(models.TupleModel):
    """Numba's model of a tuple, but for contiguous arrays as arguments."""

    def get_argument_type(self):
        """Return the types in LLVM, nested as the tuple is."""
        return tuple(_array_arguments(model) if _is_compact(kind) else model.get_argument_type()
                     for kind, model in zip(self._members, self._models))

    def as_argument(self, builder, value):
        """Return the arguments for a tuple."""
        items = [self.get(builder, value, k) for k in range(len(self._members))]
        return tuple(_taken_apart(builder, kind, model, item) if _is_compact(kind)
                     else model.as_argument(builder, item)
                     for kind, model, item in zip(self._members, self._models, items))

    def from_argument(self, builder, value):
        """Return the tuple of some arguments."""
        whole = ir.Constant(self.get_value_type(), ir.Undefined)
        for k, (kind, model, part) in enumerate(zip(self._members, self._models, value)):
            item = (_put_together(builder, kind, model, *part) if _is_compact(kind)
                    else model.from_argument(builder, part))
            whole = self.set(builder, whole, item, k)
        return whole


def _is_compact(kind) -> bool:
    return isinstance(kind, types.Array) and kind.layout == 'C' and kind.ndim > 0


def _array_arguments(model) -> tuple:
    """Return the types in LLVM of an array's address and shape."""
    fields = model.get_value_type().elements
    shape = fields[model.get_field_position('shape')]
    return fields[model.get_field_position('data')], *[shape.element] * shape.count


def _taken_apart(builder, kind, model, array) -> tuple:
    """Return an array's address and shape."""
    shape = model.get_field_position('shape')
    return (builder.extract_value(array, model.get_field_position('data')),
            *[builder.extract_value(array, [shape, k]) for k in range(kind.ndim)])


def _put_together(builder, kind, model, data, *shape):
    """Return the array of an address and a shape."""
    size = shape[0].type
    item = size(as_dtype(kind.dtype).itemsize)
    strides = [item]
    for extent in shape[:0:-1]:
        strides.insert(0, builder.mul(extent, strides[0]))
    count = shape[0]
    for extent in shape[1:]:
        count = builder.mul(count, extent)
    array = ir.Constant(model.get_value_type(), [
        item if name == 'itemsize' else ir.Constant(
            field, None if name in ('meminfo', 'parent') else ir.Undefined)
        for name, field in zip(model._fields, model.get_value_type().elements)])

    def put(value, *place):
        return builder.insert_value(array, value, [model.get_field_position(place[0]), *place[1:]])
    array = put(data, 'data')
    array = put(count, 'nitems')
    for k, (extent, stride) in enumerate(zip(shape, strides)):
        array = put(extent, 'shape', k)
        array = put(stride, 'strides', k)
    return array


def tuple_model(manager, kind):
    """Return the model of a named tuple's type; those of other packages have Numba's."""
    ours = kind.instance_class.__module__.partition('.')[0] == PACKAGE
    return (CompactTuple if ours else models.TupleModel)(manager, kind)
