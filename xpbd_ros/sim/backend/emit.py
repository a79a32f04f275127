"""
Calls that Numba writes out where they stand, whatever the types.

A function of its own would be handed all the arrays of a scene, one number after another, and take
longer to compile than all that it calls.
"""

from collections.abc import Callable
from inspect import signature

from numba import types
from numba.extending import lower_builtin, models, type_callable

WRITTEN: dict[Callable, Callable] = {}
"""function that writes the code of a stub's calls, by stub"""


class Writer:
    """Writes calls into a function that Numba compiles; a value is its type and what LLVM has."""

    def __init__(self, context, builder):
        self.context = context
        self.builder = builder

    def call(self, function, *values):
        """Call a kernel, or a stub, and return what it returns."""
        typing, (kinds, arguments) = self.context.typing_context, zip(*values)
        kind = typing.resolve_value_type(function)
        known = typing.resolve_function_type(kind, kinds, {})
        code = self.context.get_function(kind, known)
        return known.return_type, code(self.builder, [
            self.context.cast(self.builder, value, *types_)
            for value, *types_ in zip(arguments, kinds, known.args)])

    def item(self, value, k):
        """Return an item of a tuple, by its place or its name."""
        kind, found = value
        k = kind.fields.index(k) if isinstance(k, str) else k
        model = self.context.data_model_manager[kind]
        found = (model.get(self.builder, found, k) if isinstance(model, models.StructModel)
                 else self.builder.extract_value(found, k))
        return kind.types[k], found

    def tuple(self, values):
        """Return a tuple of values."""
        return self._made(types.BaseTuple.from_types([kind for kind, _ in values]), values)

    def named(self, kind: type, *values):
        """Return a NamedTuple of values."""
        return self._made(types.NamedTuple([each for each, _ in values], kind), values)

    def _made(self, kind, values):
        return kind, tuple_of(self.context, self.builder, kind, [found for _, found in values])

    def truth(self, value: bool):
        """Return a truth value."""
        return types.boolean, self.context.get_constant(types.boolean, value)

    def number(self, value: float):
        """Return a number."""
        return types.float64, self.context.get_constant(types.float64, value)

    def integer(self, value: int):
        """Return a whole number."""
        return types.intp, self.context.get_constant(types.intp, value)

    def only_if(self, value):
        """Return a context for calls that depend on a value."""
        return self.builder.if_then(value[1])


def tuple_of(context, builder, kind, items):
    """Return a tuple of a type, of what LLVM has of its items."""
    model = context.data_model_manager[kind]
    if not isinstance(model, models.StructModel):
        return context.make_tuple(builder, kind, items)
    found = context.get_constant_undef(kind)
    for k, item in enumerate(items):
        found = model.set(builder, found, item, k)
    return found


def written_out(stub):
    """Register what a stub calls: a function of a Writer and the arguments, without keywords."""
    def register(write):
        def typer(*kinds):
            return types.none
        known = signature(stub)
        typer.pysig = known  # type: ignore[attr-defined]

        def lower(context, builder, signature_, arguments):
            write(Writer(context, builder), *zip(signature_.args, arguments))
            return context.get_dummy_value()
        type_callable(stub)(lambda typing: typer)
        lower_builtin(stub, *[types.Any] * len(known.parameters))(lower)
        WRITTEN[stub] = write
        return write
    return register
