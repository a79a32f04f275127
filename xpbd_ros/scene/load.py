"""Find, read and check scene files: YAML to ``Scene``."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import sys
from typing import Any

import yaml

from xpbd_ros.effects import EFFECTS, load as load_effect, SECTIONS
from xpbd_ros.errors import brief, InputError
from xpbd_ros.scene.materials import with_material
from xpbd_ros.scene.model import ClothKeys, Grid, Scene, SolverKeys, TopKeys, with_key
from xpbd_ros.scene.read import mapping, names, read, unknown
from xpbd_ros.share import shipped_scenes
from xpbd_ros.sim.geometry.mesh import grid_spacing, is_square

LARGEST_FILE = 16 * 2**20
"""size of a scene file, at most [bytes]"""


class _Loader(yaml.SafeLoader):
    """Safe YAML that refuses duplicate keys, and numbers to base 8 or 60."""


def _mapping_once(loader, node, deep=False):
    """Construct a mapping; refuse duplicate keys and keys that are not scalars."""
    seen = set()
    for key_node, _ in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise yaml.constructor.ConstructorError(
                None, None, 'a key must be a name', key_node.start_mark)
        if key_node.tag == 'tag:yaml.org,2002:merge':
            raise yaml.constructor.ConstructorError(
                None, None, "merge keys ('<<') are not supported; write their keys out",
                key_node.start_mark)
        key = loader.construct_object(key_node, deep=True)
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"key '{key}' is given twice", key_node.start_mark)
        seen.add(key)
    return loader.construct_mapping(node, deep)


def _decimal(loader, node):
    """Construct a number; refuse what YAML 1.1 reads to base 8 (010) or 60 (1:30)."""
    value = getattr(loader, f'construct_yaml_{node.tag.rpartition(":")[2]}')(node)
    text = node.value.replace('_', '')
    if ':' in text:
        base, other = 60, f"or '{node.value}' for text"
    elif text.lstrip('+-').isdecimal() and int(text) != value:
        base, other = 8, f'or {int(text)}'
    else:
        return value
    raise yaml.constructor.ConstructorError(
        None, None, f'{node.value} is {value} in YAML 1.1 (base {base}); write {value}, {other}',
        node.start_mark)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping_once)
_Loader.add_constructor('tag:yaml.org,2002:int', _decimal)
_Loader.add_constructor('tag:yaml.org,2002:float', _decimal)


def find_scene(name: str) -> Path:
    """Return the scene file of a path or of the name of a shipped scene."""
    path = Path(name)
    try:
        if path.is_file():
            return path
    except OSError as error:    # such as a name that is too long
        raise InputError(f'{brief(name)}: {error.strerror}') from None
    if path.suffix in ('.yaml', '.yml'):
        raise InputError(f'{name}: ' + ('is a folder' if path.is_dir() else 'no such file'))
    shipped = shipped_scenes()
    if name not in shipped and path.is_dir():
        what = 'of a log, which xpbd_ros resim solves again' if any(path.glob('*.mcap')) else ''
        raise InputError(f"{name or repr(name)}: is a folder{what and f' {what}'}; give a .yaml "
                         f'file, or one of {", ".join(shipped)}')
    if name not in shipped:
        raise InputError(f"{name}: {unknown(name, shipped, 'scene')}; or give a .yaml file")
    return shipped[name]


def load_scene(name: str, overrides: dict[str, Any] | None = None,
               topic_text: Callable[[str], str] | None = None) -> Scene:
    """
    Read and check a scene.

    Parameters
    ----------
    name : path of a scene file, or name of a shipped scene
    overrides : values by dotted key, which replace those of the file
    topic_text : returns the text on a topic, for descriptions of robots; None where topics cannot
        be read

    Raises
    ------
    InputError : with file, key, value, unit and remedy

    """
    path = find_scene(name)
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise InputError(f'{path}: its name is no text in the encoding of file names, '
                         f'{sys.getfilesystemencoding()}, and no log can hold it; rename it, or '
                         'set LC_ALL=C.UTF-8') from None
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f'{path}: larger than {LARGEST_FILE >> 20} MiB')
        text = path.read_text(encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: not UTF-8 text ({error.reason} at byte '
                         f'{error.start})') from error
    return scene_from_text(text, where=str(path), name=path.stem, overrides=overrides,
                           folder=path.parent, topic_text=topic_text)


def parse_yaml(text: str, where: str) -> Any:
    """Return a parsed YAML text; raise InputError with one line about a syntax error."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        at = f'line {mark.line + 1}, column {mark.column + 1}: ' if mark else ''
        problem = getattr(error, 'problem', None) or str(error).splitlines()[0]
        if problem.startswith('but '):
            problem = f'{error.context}, {problem}'
        raise InputError(f'{where}: {at}{problem}') from error
    except (RecursionError, ValueError, OverflowError) as error:
        raise InputError(f'{where}: cannot be read as YAML ({error})') from error


def scene_from_text(text: str, *, where: str, name: str,
                    overrides: dict[str, Any] | None = None, folder: Path | None = None,
                    topic_text: Callable[[str], str] | None = None) -> Scene:
    """Check a scene given as YAML text; ``where`` names it in errors."""
    return scene_from_mapping(parse_yaml(text, where), where=where, name=name,
                              overrides=overrides, folder=folder, topic_text=topic_text)


def scene_from_mapping(raw: Any, *, where: str, name: str,
                       overrides: dict[str, Any] | None = None, folder: Path | None = None,
                       topic_text: Callable[[str], str] | None = None) -> Scene:
    """Check a scene given as plain values; paths in it are relative to ``folder`` (None: cwd)."""
    try:
        raw = mapping(raw, 'the scene')
        for key, value in (overrides or {}).items():
            _check_member(raw, key)
            raw = with_key(raw, key, value)
        robots: dict = {}
        if raw.get('robots') is not None:
            from xpbd_ros.scene.robots import with_robots
            raw, robots = with_robots(raw, folder or Path(), topic_text)
        inputs: dict = {}
        if raw.get('inputs') is not None:
            from xpbd_ros.scene.inputs import with_inputs
            raw, inputs = with_inputs(raw)
        return replace(_scene(_resolved(raw, folder or Path()), where, name), robots=robots,
                       inputs=inputs)
    except InputError as error:
        raise InputError(f'{where}: {brief(str(error))}') from None


def _check_member(raw: dict, key: str) -> None:
    """
    Refuse an override of a key in a cloth, pin, collider, seam or robot that is not in the scene.

    A misspelt name would otherwise create a new one. Whole sections may be given, with new names.
    """
    section, _, rest = key.partition('.')
    name = rest.partition('.')[0]
    if name and section in ('cloths', 'robots', *SECTIONS):
        known = mapping(raw.get(section), section)
        if name not in known:
            raise InputError(f'{section}.{name}: ' + (
                unknown(name, known, section.removesuffix('s')) if known
                else 'the scene has none'))


def settings_overrides(file: str) -> dict[str, Any]:
    """Return the overrides in a settings file, which holds a ``solver:`` block."""
    path = Path(file)
    if not path.is_file():
        raise InputError(f'{file}: no such file')
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'{file}: cannot be read ({error})') from error
    raw = parse_yaml(text, file)
    if not isinstance(raw, dict) or set(raw) != {'solver'}:
        raise InputError(f"{file}: must hold one section, 'solver:'")
    try:
        read(SolverKeys, raw['solver'], 'solver')
    except InputError as error:
        raise InputError(f'{file}: {brief(str(error))}') from None
    return {f'solver.{key}': value for key, value in raw['solver'].items()}


def _resolved(raw: dict, folder: Path) -> dict:
    """Return a scene's mapping with materials replaced by values, and with absolute paths."""
    cloths = {}
    for name, cloth in names(raw.get('cloths'), 'cloths').items():
        cloths[name] = _found(with_material(
            cloth, f'cloths.{name}', square=_square_cells(cloth, f'cloths.{name}.grid')),
            'mesh', folder)
    raw = {**raw, 'cloths': cloths} if cloths else raw
    solver = raw.get('solver')
    if isinstance(solver, dict) and isinstance(solver.get('cost_table'), str):
        file = str((folder / solver['cost_table']).absolute())
        raw = {**raw, 'solver': {**solver, 'cost_table': file}}
    colliders = raw.get('colliders')
    if not isinstance(colliders, dict):
        return raw
    return {**raw, 'colliders': {name: _found(_found(entry, 'mesh', folder), 'heights', folder)
                                 for name, entry in colliders.items()}}


def _square_cells(cloth: Any, path: str) -> bool:
    """Return whether a cloth's mapping describes a grid with square cells."""
    if not isinstance(cloth, dict) or not isinstance(cloth.get('grid'), dict):
        return False
    grid = read(Grid, cloth['grid'], path)
    return min(grid.resolution) > 1 and is_square(grid_spacing(grid.size, grid.resolution))


def _found(entry: Any, key: str, folder: Path) -> Any:
    """Return an entry of the scene, with the file under one of its keys as an absolute path."""
    keys = entry.get(key) if isinstance(entry, dict) else None
    if isinstance(keys, dict) and isinstance(keys.get('file'), str) and keys['file']:
        return {**entry, key: {**keys, 'file': str((folder / keys['file']).absolute())}}
    return entry


def _scene(raw: dict, where: str, name: str) -> Scene:
    """Check a scene's mapping."""
    top = read(TopKeys, raw, '', left_to_others=('cloths', 'effects', 'inputs', 'robots',
                                                 *SECTIONS))
    cloths, cloth_effects = {}, {}
    for cloth, value in names(raw.get('cloths'), 'cloths').items():
        path = f'cloths.{cloth}'
        cloths[cloth] = read(ClothKeys, value, path, left_to_others=('effects',))
        if cloths[cloth].density is None:
            raise InputError(f'{path}.density: missing (kg/m²); or name a material')
        cloth_effects[cloth] = _effects(mapping(value, path).get('effects'),
                                        f'{path}.effects', 'cloth')
    if not cloths:
        raise InputError('cloths: missing; a scene needs at least one cloth')
    effects = _effects(raw.get('effects'), 'effects', 'scene')
    sections = {}
    for section, effect in SECTIONS.items():
        if raw.get(section) is None:
            continue
        entry = load_effect(effect).entry
        assert entry is not None
        sections[section] = {key: read(entry, value, f'{section}.{key}')
                             for key, value in names(raw[section], section).items()}
        if effect not in effects:
            try:
                effects[effect] = load_effect(effect).parameters()
            except TypeError:
                raise InputError(f'{section}: needs effects.{effect}, and the scene does not '
                                 'name it') from None
    for effect in [*effects]:
        for brought in load_effect(effect).brings:
            effects.setdefault(brought, load_effect(brought).parameters())
    used = set(effects).union(*cloth_effects.values())
    for effect in used:
        needs = load_effect(effect).needs
        if needs and not used.intersection(needs):
            raise InputError(f'effects.{effect}: needs {" or ".join(needs)}, and the scene has '
                             f'{"neither" if len(needs) == 2 else "none"}')
    return Scene(name, top, cloths, cloth_effects, effects, sections, raw, where)


def _effects(value: Any, path: str, scope: str) -> dict[str, Any]:
    """Return the parameters of the effects in an ``effects`` mapping; scope: cloth or scene."""
    found = {}
    for name, parameters in mapping(value, path).items():
        known = [effect for effect, its_scope in EFFECTS.items() if its_scope == scope]
        if name in EFFECTS and EFFECTS[name] != scope:
            home = 'effects' if scope == 'cloth' else 'cloths.<name>.effects'
            raise InputError(f'{path}.{name}: belongs under {home}')
        if name not in known:
            raise InputError(f'{path}.{name}: {unknown(name, known, "effect")}')
        found[name] = read(load_effect(name).parameters, parameters, f'{path}.{name}')
    return found
