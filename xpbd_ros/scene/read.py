"""Convert plain values from YAML to frozen dataclasses; errors name the key and the remedy."""

from dataclasses import fields, is_dataclass, MISSING
from difflib import get_close_matches
from math import isfinite, sqrt
import re
import reprlib
import types
from typing import Any, get_args, get_origin, get_type_hints, Union

from xpbd_ros.errors import InputError

NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')
LEAST = 1e-300
"""smallest magnitude of a number other than 0; products of smaller ones underflow"""
NAME = re.compile(r'[A-Za-z_][A-Za-z0-9_]*')


def unknown(key: Any, known, what: str) -> str:
    """Return a text that a name is unknown, with the closest known one."""
    known = list(known)
    near = get_close_matches(str(key), known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ''
    return f'unknown {what}{hint} (known: {", ".join(known)})'


def mapping(value: Any, path: str, form: str = '') -> dict:
    """Return a mapping; None becomes an empty one, other types are refused with its form."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f'{path}: must be a mapping{form and f" {form}"} (got {_short(value)})')
    return value


def names(value: Any, path: str) -> dict:
    """Return a mapping; refuse keys that are not valid as part of a ROS name."""
    for name in mapping(value, path):
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise InputError(f'{path}.{name}: a name must match [A-Za-z_][A-Za-z0-9_]*')
    return mapping(value, path)


def read(kind: type, value: Any, path: str, *, left_to_others: tuple[str, ...] = ()) -> Any:
    """
    Return a dataclass filled from a mapping; refuse unknown and missing keys and bad values.

    Parameters
    ----------
    kind : dataclass
    value : mapping of its fields
    path : dotted key of the mapping, for error messages
    left_to_others : further keys that the mapping may have

    """
    value = mapping(value, path, _form(kind))
    known = {field.name: field for field in fields(kind)}
    hints = get_type_hints(kind)
    for key in value:
        if key not in known and key not in left_to_others:
            raise InputError(f'{_join(path, key)}: '
                             f'{unknown(key, (*known, *left_to_others), "key")}')
    arguments = {}
    for name, field in known.items():
        where = _join(path, name)
        if name in value:
            arguments[name] = _value(hints[name], value[name], where, field.metadata)
        elif field.default is MISSING and field.default_factory is MISSING:
            unit = field.metadata.get('unit')
            raise InputError(f'{where}: missing' + (f' ({unit})' if unit else ''))
    try:
        return kind(**arguments)
    except InputError as error:
        raise InputError(f'{path}: {error}' if path else str(error)) from None


def _value(kind: Any, value: Any, path: str, metadata) -> Any:
    """Convert one value to the type of its field."""
    if get_origin(kind) in (Union, types.UnionType):
        kinds = [k for k in get_args(kind) if k is not type(None)]
        if value is None:
            unit = f' ({metadata["unit"]})' if metadata.get('unit') else ''
            form = _form(kinds[0]) or ('{}' if is_dataclass(kinds[0]) else f'one{unit}')
            raise InputError(f'{path}: has no value; give it {form}, or leave it out')
        fits = [k for k in kinds if (get_origin(k) is tuple and isinstance(value, list))
                or (is_dataclass(k) and isinstance(value, dict))]
        if not fits and kinds[0] is str and not isinstance(value, str) and any(
                get_origin(k) is tuple for k in kinds):
            raise InputError(f'{path}: must be text or a list (got {_short(value)})')
        kind = fits[0] if fits else kinds[0]
    if isinstance(kind, type) and is_dataclass(kind):
        return read(kind, value, path)
    if get_origin(kind) is tuple:
        return _tuple(get_args(kind), value, path, metadata)
    if get_origin(kind) is dict:
        inner = get_args(kind)[1]
        return {k: _value(inner, v, f'{path}.{k}', metadata)
                for k, v in names(value, path).items()}
    if kind is str:
        return _text(value, path, metadata)
    if kind is bool:
        if not isinstance(value, bool):
            raise InputError(f'{path}: must be true or false (got {_short(value)})')
        return value
    return _number(kind, value, path, metadata)


def _form(kind: Any) -> str:
    """Return the required keys of a dataclass with their units, such as '{radius: m}'; or ''."""
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return ''
    needed = [f'{field.name}: {field.metadata.get("unit") or "…"}' for field in fields(kind)
              if field.default is MISSING and field.default_factory is MISSING]
    return f'{{{", ".join(needed)}}}' if needed else ''


def _tuple(kinds: tuple, value: Any, path: str, metadata) -> tuple:
    what = 'entries' if is_dataclass(kinds[0]) else 'numbers'
    if metadata.get('unit') and what == 'numbers':
        what = f'numbers in {metadata["unit"]}'
    if not isinstance(value, list | tuple):
        form = 'a list' if kinds[-1] is Ellipsis else f'a list of {len(kinds)} {what}'
        raise InputError(f'{path}: must be {form} (got {_short(value)})')
    if kinds[-1] is Ellipsis:
        return tuple(_value(kinds[0], v, f'{path}[{k}]', metadata) for k, v in enumerate(value))
    if len(value) != len(kinds):
        raise InputError(f'{path}: must be {len(kinds)} {what} (got {len(value)})')
    result = tuple(_value(k, v, f'{path}[{n}]', metadata)
                   for n, (k, v) in enumerate(zip(kinds, value)))
    if len(kinds) == 4:
        norm = sqrt(sum(c * c for c in result))
        if not 0.9 < norm < 1.1:
            raise InputError(f'{path}: must be a unit quaternion x y z w '
                             f'(got length {norm:.3g})')
        result = tuple(c / norm for c in result)
    return result


def _text(value: Any, path: str, metadata) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(f'{path}: must be text (got {_short(value)})')
    choices = metadata.get('choices')
    if choices and value not in choices:
        raise InputError(f"{path}: {unknown(value, choices, 'value')[:-1]}; got '{value}')")
    return value


def _number(kind: type, value: Any, path: str, metadata) -> float | int:
    """Convert a number and check its range; text such as 1e-5, no number in YAML 1.1, is one."""
    unit = f' {metadata["unit"]}' if metadata.get('unit') else ''
    if isinstance(value, str) and NUMBER.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        of_unit = f' in{unit}' if unit else ''
        raise InputError(f'{path}: must be a number{of_unit} (got {_short(value)})')
    if isinstance(value, int) and abs(value) > 2**63:
        raise InputError(f'{path}: must be finite{unit} (got a number of {value.bit_length()} '
                         'bits)')
    if not isfinite(value):
        raise InputError(f'{path}: must be finite{unit} (got {value})')
    if 0.0 < abs(value) < LEAST:
        raise InputError(f'{path}: must be 0 or at least {LEAST:g}{unit} in size (got {value})')
    if kind is int and value != int(value):
        raise InputError(f'{path}: must be a whole number (got {value})')
    above, least, most = (metadata.get(k) for k in ('above', 'minimum', 'maximum'))
    if above is not None and not value > above:
        raise InputError(f'{path}: must be > {above:g}{unit} (got {value})')
    if least is not None and not value >= least:
        raise InputError(f'{path}: must be at least {least:g}{unit} (got {value})')
    if most is not None and not value <= most:
        raise InputError(f'{path}: must be at most {most:g}{unit} (got {value})')
    return kind(value)


def _join(path: str, key: Any) -> str:
    return f'{path}.{key}' if path else str(key)


def _short(value: Any) -> str:
    text = reprlib.repr(value)    # bounded: repr of nested YAML aliases can be exponentially long
    return text if len(text) <= 40 else text[:37] + '...'
