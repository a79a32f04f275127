"""Write a scene as it runs to plain values and to YAML."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import yaml

from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.stepping.solver import Solver

DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""the C implementation if PyYAML has it, as a node writes the scene between two frames"""

RESOLVED = ('method', 'integrator', 'substeps', 'iterations', 'precision', 'threads',
            'rough_frames', 'rough_integrator', 'rough_substeps')
"""keys of ``solver`` that ``auto`` resolves"""


def scene_text(scene: Scene, solver: Solver) -> str:
    """
    Return the YAML text of a scene with overrides applied and ``auto`` resolved.

    Floats keep all digits, so a simulation of it computes the same bits on every machine.
    """
    note = f'# {scene.name}; {solver.reason}\n'
    return note + yaml.dump(explicit(scene, solver), Dumper=DUMPER, sort_keys=False,
                            default_flow_style=None)


def explicit(scene: Scene, solver: Solver) -> dict:
    """Return a scene as plain values, with ``auto`` resolved and every default written out."""
    raw, chosen = scene.raw, resolved_keys(solver)
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


def resolved_keys(solver: Solver) -> dict[str, Any]:
    """
    Return the resolved keys of ``solver``.

    A mix of methods is ``explicit`` with ``rough_frames``, also where its substeps are too few for
    ``explicit`` and all its frames are of ``line``.
    """
    found = {**{key: getattr(solver, key) for key in RESOLVED}, 'cost_table': None}
    return {**found, 'method': 'explicit', 'integrator': 'leapfrog'} if solver.mixes else found


def _all_stated(values: dict[str, Any], given: dict | None) -> dict:
    """Return dataclasses by name as mappings."""
    return {name: _stated(value, (given or {}).get(name)) for name, value in values.items()}


def _stated(values: Any, given: dict | None) -> dict:
    """
    Return a dataclass as a mapping: given values as they were given, defaults elsewhere.

    A key that is not given and whose default is None is left out.
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
    """Return a value with tuples as lists, since YAML has no tuples."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value
