"""
Narrow the named tuples that a part of a kernel is given to the fields that it reads.

The type of the state depends on integrator, method, pins and threads. A part that reads no such
field need not be compiled again for each combination. In the types of its arguments, fields that
are read neither by the part nor by a kernel that it calls are therefore ``none``.
"""

import ast
from functools import cache
from pathlib import Path

from numba import types
from numba.core.dispatcher import Dispatcher

from xpbd_ros.sim.backend.emit import tuple_of

ALL = None
"""in place of a set of fields: the argument is used as a whole"""
_KNOWN: dict = {}


def narrowed(function, kinds) -> list:
    """Return the types of a kernel's positional arguments, reduced to the fields that it reads."""
    return [_narrow(kind, names) for kind, names in zip(kinds, fields_read(function))]


def _narrow(kind, names):
    if names is ALL or not isinstance(kind, types.NamedTuple):
        return kind
    return types.NamedTuple([each if name in names else types.none
                             for name, each in zip(kind.fields, kind)], kind.instance_class)


def fields_read(function) -> list[set[str] | None]:
    """Return the fields of each parameter that a kernel, or one that it calls, may read."""
    if function not in _KNOWN:
        code = function.__code__
        names = code.co_varnames[:code.co_argcount]
        _KNOWN[function] = [ALL] * len(names)    # for a recursive call
        definition = _definitions(code.co_filename).get((function.__name__, code.co_firstlineno))
        if definition is not None:
            found: dict[str, set[str] | None] = {name: set() for name in names}
            for statement in definition.body:
                _note(statement, function, found)
            _KNOWN[function] = [found[name] for name in names]
    return _KNOWN[function]


@cache
def _definitions(file: str) -> dict[tuple[str, int], ast.FunctionDef]:
    """Return the functions of a source file by name and first line."""
    try:
        tree = ast.parse(Path(file).read_bytes())    # text has the encoding of the locale
    except OSError:    # compiled from text, not from a file
        return {}
    return {(node.name, min([node.lineno, *(each.lineno for each in node.decorator_list)])): node
            for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def _note(node: ast.AST, function, found) -> None:
    """Note the fields that a piece of a function's code reads."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        _add(found, node.value.id, {node.attr})
        return
    if _compares_with_none(node):
        return
    if isinstance(node, ast.Name):
        _add(found, node.id, ALL)
    inside = list(ast.iter_child_nodes(node))
    if isinstance(node, ast.Call):
        for each, names in zip(node.args, _fields_read_by(node.func, function)):
            if isinstance(each, ast.Name):
                _add(found, each.id, names)
                inside.remove(each)
    for each in inside:
        _note(each, function, found)


def _add(found, name: str, names: set[str] | None) -> None:
    if name in found:
        found[name] = ALL if names is ALL or found[name] is ALL else found[name] | names


def _compares_with_none(node: ast.AST) -> bool:
    """Return True for ``name is None`` and ``name is not None``, which read no field."""
    return (isinstance(node, ast.Compare) and isinstance(node.left, ast.Name)
            and all(isinstance(each, ast.Constant) and each.value is None
                    for each in node.comparators))


def _fields_read_by(node: ast.AST, function) -> list[set[str] | None]:
    """Return ``fields_read`` of the kernel that is called; empty if it is none."""
    called = None
    if isinstance(node, ast.Name) and node.id not in function.__code__.co_varnames:
        called = function.__globals__.get(node.id)
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        called = getattr(function.__globals__.get(node.value.id), node.attr, None)
    if isinstance(called, Dispatcher) and hasattr(called, 'part'):
        return fields_read(called.py_func)
    return []


def cast_fields(context, builder, before, kind, value):
    """Return a named tuple with fields of other types, or ``none``."""
    model = context.data_model_manager[before]
    return tuple_of(context, builder, kind, [
        context.get_dummy_value() if each is types.none else
        context.cast(builder, model.get(builder, value, k), before[k], each)
        for k, each in enumerate(kind)])
