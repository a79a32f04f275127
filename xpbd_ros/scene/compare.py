"""Compare two scenes key by key, defaults included."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from xpbd_ros.scene.model import Scene
from xpbd_ros.scene.save import resolved_keys
from xpbd_ros.sim.stepping.solver import Solver

WITHOUT_EFFECT = {'duration', 'frame_id', 'solver.threads', 'solver.budget_ms'}
"""keys that no state depends on, once ``auto`` is resolved"""
MOST = 5
"""texts of a kind that are listed one by one"""


def with_solver(scene: Scene, solver: Solver) -> Scene:
    """Return a scene with the setting that ``auto`` chose for it."""
    keys = replace(scene.top.solver, **resolved_keys(solver))
    return replace(scene, top=replace(scene.top, solver=keys))


def differences(ours: Scene, theirs: Scene) -> list[tuple[str, Any, Any]]:
    """
    Return the differing keys that states depend on, each as (key, our value, their value).

    The value of a key that a scene does not have is None. Paths of files are not compared, since
    they say nothing about the content.
    """
    one, other = dict(_keys(ours)), dict(_keys(theirs))
    return [(key, one.get(key), other.get(key)) for key in dict.fromkeys((*one, *other))
            if one.get(key) != other.get(key)
            and key not in WITHOUT_EFFECT and not key.endswith('.file')]


def _keys(scene: Scene) -> Iterator[tuple[str, Any]]:
    yield from _walk('', scene.top)
    for name, cloth in scene.cloths.items():
        yield from _walk(f'cloths.{name}', cloth)
        yield from _walk(f'cloths.{name}.effects', scene.cloth_effects[name])
    for section, entries in scene.sections.items():
        yield from _walk(section, entries)
    yield from _walk('effects', scene.effects)


def _walk(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield (dotted key, value) for all leaves of a mapping or dataclass."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if not isinstance(value, dict):
        yield path, value
        return
    if path and not value:
        yield path, {}
    for key, inner in value.items():
        yield from _walk(f'{path}.{key}' if path else key, inner)


def difference_texts(found: list[tuple[str, Any, Any]]) -> list[str]:
    """Return the differences from a recorded scene as texts."""
    return first_texts([f'scene: {key}: {as_text(ours)} here, {as_text(theirs)} in the log'
                        for key, ours, theirs in found], 'keys differ')


def first_texts(items: list[str], what: str) -> list[str]:
    """Return the first MOST texts and, if there are more, a text with their number."""
    more = len(items) - MOST
    return [*items[:MOST], *[f'{more} more {what}'] * (more > 0)]


def as_text(value: Any) -> str:
    """Return a value of a scene as text, shortened."""
    if value is None:
        return 'not set'
    found = str(list(value)) if isinstance(value, tuple) else str(value)
    return found if len(found) <= 60 else f'{found[:57]}...'
