"""
Contiguous arrays in this package's named tuples are an address and a shape.

Numba's array is two owners, two sizes, an address, a shape and strides, and it passes a tuple to a
function as all the numbers that it holds. For the state and the effects of a scene that makes
hundreds of arguments of every call, and most of the instructions that LLVM reads. Strides and
sizes of a contiguous array follow from its shape: a kernel that reads a field computes those of
its array, which LLVM moves out of loops. Its owners are null within a kernel, so a kernel must not
return to Python an array that it got in a named tuple.
"""

from functools import partial

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.boxing import unbox_tuple
from numba.core.datamodel import models
from numba.core.imputils import impl_ret_borrowed
from numba.core.pythonapi import NativeValue
from numba.np.numpy_support import as_dtype

from xpbd_ros.sim.backend.emit import tuple_of

PACKAGE = __name__.partition('.')[0]


class CompactTuple(models.TupleModel):
    """Numba's model of a tuple, but for contiguous arrays."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind)
        self.compact = [isinstance(each, types.Array) and each.layout == 'C' and each.ndim > 0
                        for each in self._members]
        self._value_type = self._data_type = ir.LiteralStructType([
            ir.LiteralStructType(_address_and_shape(model)) if compact else model.get_value_type()
            for compact, model in zip(self.compact, self._models)])

    def get(self, builder, value, pos):
        """Return a field, by its place or Numba's name of it."""
        pos = self.get_field_position(pos) if isinstance(pos, str) else pos
        item = builder.extract_value(value, pos)
        if not self.compact[pos]:
            return item
        count = len(item.type.elements)
        return _array(builder, self._members[pos], self._models[pos],
                      *(builder.extract_value(item, k) for k in range(count)))

    def set(self, builder, value, item, pos):
        """Return the tuple with another field."""
        if not self.compact[pos]:
            return builder.insert_value(value, item, pos)
        model = self._models[pos]
        data, shape = map(model.get_field_position, ('data', 'shape'))
        for k, place in enumerate([[data], *([shape, k] for k in range(self._members[pos].ndim))]):
            value = builder.insert_value(value, builder.extract_value(item, place), [pos, k])
        return value

    def get_argument_type(self):
        """Return the types in LLVM of the arguments, nested as the tuple is."""
        return tuple(tuple(kind.elements) if compact else model.get_argument_type()
                     for compact, kind, model in self._parts())

    def as_argument(self, builder, value):
        """Return the arguments for a tuple."""
        return tuple(
            tuple(builder.extract_value(value, [n, k]) for k in range(len(kind.elements)))
            if compact else model.as_argument(builder, builder.extract_value(value, n))
            for n, (compact, kind, model) in enumerate(self._parts()))

    def from_argument(self, builder, value):
        """Return the tuple of some arguments."""
        whole = ir.Constant(self.get_value_type(), ir.Undefined)
        for n, ((compact, _, model), part) in enumerate(zip(self._parts(), value)):
            if compact:
                for k, number in enumerate(part):
                    whole = builder.insert_value(whole, number, [n, k])
            else:
                whole = builder.insert_value(whole, model.from_argument(builder, part), n)
        return whole

    def _parts(self):
        """Return of each field: is it compact, its type in LLVM, Numba's model."""
        return zip(self.compact, self._value_type.elements, self._models)

    def as_data(self, builder, value):
        """Return what a kernel hands to another that called it: the same."""
        return value

    from_data = as_return = from_return = as_data

    def load_from_data_pointer(self, builder, ptr, align=None):
        """Return the tuple at an address."""
        return builder.load(ptr, align=align)


def _address_and_shape(model) -> list:
    """Return the types in LLVM of an array's address and shape."""
    fields = model.get_value_type().elements
    shape = fields[model.get_field_position('shape')]
    return [fields[model.get_field_position('data')], *[shape.element] * shape.count]


def _array(builder, kind, model, data, *shape):
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


def field(context, builder, kind, value, name):
    """Return a field of a named tuple by its name."""
    k = kind.fields.index(name)
    found = context.data_model_manager[kind].get(builder, value, k)
    return impl_ret_borrowed(context, builder, kind[k], found)


def made(context, builder, signature, fields):
    """Return a named tuple of fields."""
    kind = signature.return_type
    found = tuple_of(context, builder, kind, [
        context.cast(builder, value, *types_) for value, *types_ in zip(
            fields, signature.args, kind)])
    return impl_ret_borrowed(context, builder, kind, found)


def unboxed(kind, tuple_, c):
    """Return a named tuple of Python as compiled code has it."""
    model = c.context.data_model_manager[kind]
    if not isinstance(model, CompactTuple):
        return unbox_tuple(kind, tuple_, c)
    found, wrong, cleanups = c.context.get_constant_undef(kind), cgutils.false_bit, []
    for k, each in enumerate(kind):
        native = c.unbox(each, c.pyapi.tuple_getitem(tuple_, k))
        found = model.set(c.builder, found, native.value, k)
        wrong = c.builder.or_(wrong, native.is_error)
        if native.cleanup is not None:
            cleanups.append(native.cleanup)
        if c.context.enable_nrt and model.compact[k]:    # ``found`` does not hold its owner
            cleanups.append(partial(c.context.nrt.decref, c.builder, each, native.value))

    def clean_up():
        for each in reversed(cleanups):
            each()
    return NativeValue(found, cleanup=clean_up if cleanups else None, is_error=wrong)
