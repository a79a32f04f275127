"""Quality of service by topic from a file, in the form that ``ros2 bag play`` takes."""

from collections.abc import Callable
import difflib
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
import yaml

from xpbd_ros.errors import InputError


def qos_overrides(file: Path | str) -> dict[str, QoSProfile]:
    """
    Return the profiles in a YAML file, by topic.

    Each topic has a mapping with some of the keys of KEYS; durations are ``{sec: 0, nsec: 0}``.
    """
    try:
        found = yaml.safe_load(Path(file).read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(f'{file}: cannot be read: {error.strerror}') from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f'{file}: is not YAML: {" ".join(str(error).split())}') from None
    if not isinstance(found, dict) or not all(isinstance(each, dict) for each in found.values()):
        raise InputError(f"{file}: must map topics to profiles, such as '/cloth/particles: "
                         "{reliability: best_effort, history: keep_last, depth: 1}'")
    return {topic: _profile(keys, f'{file}: {topic}') for topic, keys in found.items()}


def _profile(keys: dict, where: str) -> QoSProfile:
    """Return a profile; raise InputError with the key for a value without sense."""
    values = {}
    for key, value in keys.items():
        if key not in KEYS:
            near = difflib.get_close_matches(str(key), KEYS, 1)
            meant = f"; did you mean '{near[0]}'?" if near else ''
            raise InputError(f'{where}.{key}: unknown key{meant} (known: {", ".join(KEYS)})')
        try:
            values[key] = KEYS[key](value)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f'{where}.{key}: {error} (got {value!r})') from None
    if 'depth' in values:
        values.setdefault('history', HistoryPolicy.KEEP_LAST)
    elif values.get('history', HistoryPolicy.KEEP_LAST) == HistoryPolicy.KEEP_LAST:
        raise InputError(f"{where}: needs 'depth', unless history is keep_all")
    return QoSProfile(**values)


def _policy(kind: type) -> Callable[[Any], Any]:
    """Return a reader of a policy's name."""
    known = {each.short_key: each for each in kind    # type: ignore[attr-defined]
             if each.short_key != 'unknown'}

    def read(value: Any) -> Any:
        if value not in known:
            raise ValueError(f'must be one of {", ".join(known)}')
        return known[value]
    return read


def _duration(value: dict) -> Duration:
    if set(value) != {'sec', 'nsec'} or min(value.values()) < 0:
        raise ValueError('must be {sec: S, nsec: NS}, not negative')
    return Duration(seconds=value['sec'], nanoseconds=value['nsec'])


def _depth(value: Any) -> int:
    if type(value) is not int or value < 1:
        raise ValueError('must be a whole number >= 1')
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError('must be true or false')
    return value


KEYS: dict[str, Callable[[Any], Any]] = {
    'history': _policy(HistoryPolicy), 'depth': _depth,
    'reliability': _policy(ReliabilityPolicy), 'durability': _policy(DurabilityPolicy),
    'deadline': _duration, 'lifespan': _duration, 'liveliness': _policy(LivelinessPolicy),
    'liveliness_lease_duration': _duration, 'avoid_ros_namespace_conventions': _flag}
"""readers of the values of a profile"""
