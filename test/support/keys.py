"""The page doc/keys.md: every key of a scene, from the declarations that check it."""

from dataclasses import fields, is_dataclass, MISSING
import types
from typing import Any, get_args, get_origin, get_type_hints, Union

from xpbd_ros.effects import EFFECTS, load, SECTIONS
from xpbd_ros.scene.inputs import Input
from xpbd_ros.scene.model import ClothKeys, TopKeys
from xpbd_ros.scene.robots import RobotKeys

HEAD = '| Key | Value | Default | Live | Meaning |\n|---|---|---|---|---|'


def tables() -> str:
    """Return the headings and tables of the page."""
    cloth, scene = ({f'{name}.': load(name).parameters for name, home in EFFECTS.items()
                     if home == where} for where in ('cloth', 'scene'))
    parts = {'The scene': {'': TopKeys}, '`cloths.NAME`': {'': ClothKeys},
             '`cloths.NAME.effects`': cloth, '`effects`': scene,
             **{f'`{section}.NAME`': {'': load(effect).entry}
                for section, effect in SECTIONS.items()},
             '`robots.NAME`': {'': RobotKeys}, '`inputs.TOPIC`': {'': Input}}
    return '\n\n'.join(
        f'## {heading}\n\n{HEAD}\n' + '\n'.join(row for prefix, kind in kinds.items()
                                                for row in rows(prefix, kind))
        for heading, kinds in parts.items())


def rows(prefix: str, kind: type) -> list[str]:
    """Return the rows of a dataclass of keys, with those of the dataclasses in it."""
    found = []
    hints = get_type_hints(kind)
    for field in fields(kind):
        key, about = f'{prefix}{field.name}', field.metadata
        kinds = alternatives(hints[field.name])
        inner = [k for k in kinds if is_dataclass(k)]
        value = ', or '.join(dict.fromkeys(text_of(k, about) for k in kinds))
        if kinds != inner or about['doc']:
            live = 'yes' if about['live'] else ''
            found.append(f'| `{key}` | {value} | {default(field)} | {live} | {about["doc"]} |')
        found += [row for k in inner for row in rows(f'{key}.', k)]
        for k in kinds:
            if get_origin(k) is tuple and is_dataclass(get_args(k)[0]):
                found += rows(f'{key}[].', get_args(k)[0])
    return found


def alternatives(kind: Any) -> list:
    """Return the types that a key may have."""
    if get_origin(kind) in (Union, types.UnionType):
        return [k for k in get_args(kind) if k is not type(None)]
    return [kind]


def text_of(kind: Any, about) -> str:
    """Return what a value of a type is, with its range and unit."""
    if about['choices']:
        return ', '.join(f'`{choice}`' for choice in about['choices'])
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if is_dataclass(inner[0]):
            return f'{len(inner)} mappings'
        if get_origin(inner[0]) is tuple:
            return f'lists of numbers{within(about)}'
        what = {int: 'whole numbers', str: 'texts'}.get(inner[0], 'numbers')
        return f'{"list of" if inner[-1] is Ellipsis else len(inner)} {what}{within(about)}'
    if get_origin(kind) is dict or is_dataclass(kind):
        return 'mapping'
    what = {int: 'whole number', str: 'text', bool: '`true`, `false`'}.get(kind, 'number')
    return what + (within(about) if kind in (int, float) else '')


def within(about) -> str:
    """Return a range and a unit, such as ' ≥ 0 N'."""
    unit = f' {about["unit"]}' if about['unit'] else ''
    above, least, most = about['above'], about['minimum'], about['maximum']
    if least is not None and most is not None:
        return f' from {plain(least)} to {plain(most)}{unit}'
    signs = [f'{sign} {plain(bound)}' for sign, bound in (('>', above), ('≥', least), ('≤', most))
             if bound is not None]
    return (f' {", ".join(signs)}{unit}' if signs else f', {unit.strip()}' if unit else '')


def plain(bound: float) -> str:
    """Return a bound; large ones in groups of three digits."""
    return f'{bound:,.0f}'.replace(',', ' ') if abs(bound) >= 10_000.0 else f'{bound:g}'


def default(field) -> str:
    """Return the default of a key: nothing if it has none, or is a mapping of defaults."""
    if field.default is MISSING and field.default_factory is MISSING:
        return 'required'
    value = field.default
    if value is MISSING or value is None or is_dataclass(value):
        return ''
    if isinstance(value, tuple):
        return f'`[{", ".join(f"{number:g}" for number in value)}]`'
    return f'`{value}`' if isinstance(value, str) else f'`{value:g}`'
