"""
Typing templates of operators that Numba tries first: of arrays, vectors and numbers.

To type an operator, Numba tries its templates one after another, each with and without literal
types. For ``x[i]`` seven overloads, such as those of lists and strings, come before the template
of arrays, which takes a tenth of the time to compile. Templates for the target ``cpu`` are tried
before generic ones.
"""

from collections.abc import Callable
import operator
from typing import Any

from numba import types
from numba.extending import type_callable

try:
    from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
    from numba.core.typing.templates import infer, infer_global, make_callable_template
except ImportError:    # a Numba without these internals: the templates come last
    FIRST = False
else:
    FIRST = True


def type_first(function: Callable) -> Callable:
    """Register a function that returns the type of an operator's result, or None."""
    def register(typer):
        if not FIRST:
            return type_callable(function)(lambda typing: typer)
        template = make_callable_template(function, typer)
        template.metadata = {'target': 'cpu'}
        infer(template)
        infer_global(function, types.Function(template))
        return typer
    return register


def _is_whole(index) -> bool:
    """Return True for the type of an index by whole numbers."""
    parts = index if isinstance(index, types.BaseTuple) else [index]
    return all(isinstance(each, types.Integer) for each in parts)


def _are_alike(a, b) -> bool:
    """Return True for two types of numbers that are the same, and that of their sum."""
    return a == b and (isinstance(a, types.Float) or a == types.int64)


def _arrays_first(function: Callable, known: Any) -> None:
    """Let Numba try its own template for arrays first."""
    def generic(self, args, kws):
        return known.generic(self, args, kws) if _is_whole(args[1]) else None
    infer_global(function)(type(known.__name__, (known,), {
        'generic': generic, 'metadata': {'target': 'cpu'}}))


if FIRST:
    _arrays_first(operator.getitem, GetItemBuffer)
    _arrays_first(operator.setitem, SetItemBuffer)
type_first(bool)(lambda a: types.boolean if isinstance(a, types.Boolean) else None)
for _operation in (operator.add, operator.sub, operator.mul):
    type_first(_operation)(lambda a, b: a if _are_alike(a, b) else None)
for _operation in (operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne):
    type_first(_operation)(lambda a, b: types.boolean if _are_alike(a, b) else None)
