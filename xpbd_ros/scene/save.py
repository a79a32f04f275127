"""A scene as it runs, back to plain values and to YAML."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import yaml

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Solver

DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""the C one where PyYAML has it: a node writes the scene between two frames"""

CHOSEN = ('method', 'integrator', 'substeps', 'iterations', 'precision')
"""keys of ``solver`` that have a value once ``auto`` has chosen"""


def scene_text(scene: Scene, solver: Solver) -> str:
    """
    Return a scene that runs the same way anywhere: overrides in place, ``auto`` resolved.

    Floats keep all their digits, so a simulation made from it has the same bits.
    """
    note = f'# {scene.name}; {solver.reason}\n'
    return note + yaml.dump(explicit(scene, solver), Dumper=DUMPER, sort_keys=False,
                            default_flow_style=None)


def explicit(scene: Scene, solver: Solver) -> dict:
    """Return a scene as plain values, with ``auto`` resolved and every default in its place."""
    raw, chosen = scene.raw, {key: getattr(solver, key) for key in CHOSEN}
    top = replace(scene.top, solver=replace(scene.top.solver, **chosen))
    found = _stated(top, {**raw, 'solver': {**(raw.get('solver') or {}), **chosen}})
    found['cloths'] = {
        name: {**_stated(keys, raw['cloths'][name]),
               'effects': _all_stated(scene.cloth_effects[name],
                                      raw['cloths'][name].get('effects'))}
        for name, keys in scene.cloths.items()}
    for section, entries in scene.sections.items():
        found[section] = _all_stated(entries, raw[section])
    found['effects'] = _all_stated(scene.effects, raw.get('effects'))
    return found


def _all_stated(values: dict[str, Any], given: dict | None) -> dict:
    """Return named dataclasses as mappings."""
    return {name: _stated(value, (given or {}).get(name)) for name, value in values.items()}


def _stated(values: Any, given: dict | None) -> dict:
    """
    Return a dataclass as a mapping: what was given as it was given, then its defaults.

    A key whose default is None has no value of its own and is left out.
    """
    found = {}
    for field in fields(values):
        value, said = getattr(values, field.name), (given or {}).get(field.name)
        if is_dataclass(value):
            found[field.name] = _stated(value, said)
        elif said is not None or value is not None:
            found[field.name] = _plain(value if said is None else said)
    return found


def _plain(value: Any) -> Any:
    """Return a value without tuples, which YAML does not have."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value
