"""
MCAP ``ros2msg`` schemas of message types, read from the installed message packages.

A schema is the text of a .msg file followed by the texts of all types that it contains, each
behind a line of 80 equals signs and a line with its name. Packages are searched in the prefixes of
AMENT_PREFIX_PATH, as ament does, then where the wheels of ``xpbd_ros[ros]`` install them: in the
prefix of the interpreter, and above the Python package of the same name.
"""

from collections.abc import Iterator
import functools
import importlib.util
import json
import os
from pathlib import Path
import re
import sys

from xpbd_ros.errors import InputError

PRIMITIVES = {'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16',
              'int32', 'uint32', 'int64', 'uint64', 'string', 'wstring'}
FIELD = re.compile(r'^[ \t]*([A-Za-z][\w/]*)(?:\[[^\]\n]*\])?[ \t]+[A-Za-z]\w*',
                   re.MULTILINE)    # type, array, name of a field
SEPARATOR = '=' * 80


@functools.cache
def message_definition(type_name: str) -> str:
    """Return the schema of ``package/msg/Type``, with all types that it contains."""
    package, name = split(type_name)
    text = definition_file(package, name, 'msg').read_text(encoding='utf-8')
    needed = list(dependencies(text, package))
    parts, seen = [text], {f'{package}/{name}'}
    while needed:
        other = needed.pop(0)
        if other in seen:
            continue
        seen.add(other)
        other_package, other_name = split(other)
        text = definition_file(other_package, other_name, 'msg').read_text(encoding='utf-8')
        needed.extend(dependencies(text, other_package))
        parts.append(f'{SEPARATOR}\nMSG: {other}\n{text}')
    return '\n'.join(parts)


@functools.cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type as its package installs it; empty if it installs none."""
    package, name = split(type_name)
    try:
        description = json.loads(definition_file(package, name, 'json').read_bytes())
        return next(entry['hash_string'] for entry in description['type_hashes']
                    if entry['type_name'] == f'{package}/msg/{name}')
    except (InputError, ValueError, LookupError, StopIteration):
        return ''


def split(type_name: str) -> tuple[str, str]:
    """Return package and name of ``package/msg/Type`` or ``package/Type``."""
    found = re.fullmatch(r'(\w+)/(?:msg/)?(\w+)', type_name)
    if not found:
        raise InputError(f"{type_name}: not the name of a message type, such as 'std_msgs/msg/"
                         f"String'")
    return found[1], found[2]


def dependencies(text: str, package: str) -> Iterator[str]:
    """Yield the message types of a definition's fields as ``package/Type``."""
    for found in FIELD.finditer(text):
        if found[1] not in PRIMITIVES:
            yield found[1] if '/' in found[1] else f'{package}/{found[1]}'


def definition_file(package: str, name: str, ending: str) -> Path:
    """Return the installed file that defines a message type."""
    for prefix in prefixes(package):
        path = prefix / 'share' / package / 'msg' / f'{name}.{ending}'
        if path.is_file():
            return path
    raise InputError(f"{package}/msg/{name}: its definition is not installed; pip install "
                     f"'xpbd_ros[ros]', or source the setup file of a ROS that has {package}")


def prefixes(package: str) -> Iterator[Path]:
    """Yield the prefixes whose ``share`` folder may hold a package, in order of preference."""
    yield from map(Path, filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)))
    yield Path(sys.prefix)
    found = importlib.util.find_spec(package)
    if found and found.origin:
        yield from Path(found.origin).parents
