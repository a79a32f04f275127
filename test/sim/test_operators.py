"""Which typing template of an operator Numba tries first, and the types that result."""

import operator

from numba import types
from numba.core.registry import cpu_target
from numba.core.typing.templates import _OverloadFunctionTemplate
import pytest

from xpbd_ros.sim.backend.jit import WHY_PLAIN
from xpbd_ros.sim.backend.simd import Vector

pytestmark = pytest.mark.skipif(bool(WHY_PLAIN), reason=WHY_PLAIN)
TABLE, PLACE = types.float64[:, ::1], types.UniTuple(types.int64, 2)
VECTOR, MASK = Vector(types.float64, 4), Vector(types.boolean, 4)
FIRST = [
    (operator.getitem, (TABLE, PLACE), types.float64),
    (operator.getitem, (TABLE, types.int64), types.float64[::1]),
    (operator.setitem, (TABLE, PLACE, types.float64), types.none),
    (operator.mul, (VECTOR, VECTOR), VECTOR),
    (operator.sub, (types.float64, VECTOR), VECTOR),
    (operator.iadd, (VECTOR, types.int64), VECTOR),
    (operator.neg, (VECTOR,), VECTOR),
    (operator.lt, (VECTOR, types.float64), MASK),
    (operator.add, (types.float32, types.float32), types.float32),
    (operator.mul, (types.int64, types.int64), types.int64),
    (operator.ge, (types.float64, types.float64), types.boolean),
    (bool, (types.boolean,), types.boolean),
]
AS_EVER = [
    (operator.getitem, (TABLE, types.slice2_type), types.float64[:, ::1]),
    (operator.getitem, (types.UniTuple(types.float64, 3), types.int64), types.float64),
    (operator.add, (types.int32, types.int32), types.int64),
    (operator.mul, (types.float32, types.float64), types.float64),
    (operator.truediv, (types.int64, types.int64), types.float64),
    (operator.lt, (types.int32, types.int64), types.boolean),
    (bool, (types.int64,), types.boolean),
]


def result_of(function, kinds):
    """Return the type of an operator's result."""
    cpu_target.typing_context.refresh()
    return cpu_target.typing_context.resolve_function_type(function, kinds, {}).return_type


@pytest.mark.parametrize('function, kinds, result', FIRST)
def test_what_kernels_do_most_is_known_at_once(function, kinds, result, monkeypatch):
    def refuse(self, *arguments):
        raise AssertionError(f'Numba tried {self}')
    monkeypatch.setattr(_OverloadFunctionTemplate, '_get_impl', refuse)
    assert result_of(function, kinds) == result


@pytest.mark.parametrize('function, kinds, result', AS_EVER)
def test_all_else_has_the_types_of_numba(function, kinds, result):
    assert result_of(function, kinds) == result
