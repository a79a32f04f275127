"""
Cost of a substep by method and effect, for ``auto``: the shipped table, or one of a machine.

A substep takes

    substep + slot · slots + Σ effect · particles + iterations Σ kind · constraints   [ns]

on one core, with the entries of the method. A constraint's kind is the name of its effect where
the table has it, else ``edge`` (two particles) or ``hinge``, which on a mesh takes ``mesh`` times
as long. ``xpbd_ros cost --calibrate`` writes the table of a machine, and ``solver.cost_table``
reads it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from xpbd_ros.effects import EFFECTS
from xpbd_ros.errors import InputError

VERSION = 1
"""of the file format"""
METHODS = ('gauss_seidel', 'gauss_seidel_symmetric', 'line', 'jacobi', 'explicit')
NEEDED = ('substep', 'slot', 'edge', 'hinge')
"""entries that a table has for each method"""
KINDS = ('edge', 'hinge')
LARGEST_FILE = 1 << 20
"""[bytes]"""


@dataclass(frozen=True)
class CostTable:
    """Times on one core [ns]."""

    methods: Mapping[str, Mapping[str, float]]
    """by method: NEEDED, and constraints by the name of their effect"""
    mesh: Mapping[str, float]
    """time of a constraint of a mesh over that of one of a grid, by KINDS"""
    single: float
    """time in float32 over that in float64"""
    effects: Mapping[str, float] = field(default_factory=dict)
    """time of an effect for each particle, where it is not that of the effect's own file"""

    def substep_ns(self, method: str, iterations: int, effects, state) -> float:
        """Return the time of a substep of a scene [ns]."""
        table, particles = self.methods[method], np.count_nonzero(state.mass)
        found = table['substep'] + table['slot'] * len(state.mass)
        for name, built in effects.items():
            found += self.effects.get(name, built.ns_per_particle) * particles
            if built.constraints is not None:
                kind = 'edge' if built.constraints.particles.shape[1] == 2 else 'hinge'
                count = len(built.constraints.particles)
                on_meshes = sum(hasattr(part, 'particles') * part.particles.shape[1]
                                for part in map(_batch, built.parts) if hasattr(part, 'particles'))
                found += iterations * table.get(name, table[kind]) * (
                    count + (self.mesh[kind] - 1.0) * on_meshes * (name not in table))
        return found * (self.single if state.x.dtype == np.float32 else 1.0)


def _batch(part):
    return getattr(part, 'edges', part)


SHIPPED = CostTable(
    {'gauss_seidel': {'substep': 0.0, 'slot': 3.0, 'edge': 1.8, 'hinge': 2.4},
     'gauss_seidel_symmetric': {'substep': 0.0, 'slot': 3.5, 'edge': 3.6, 'hinge': 4.6},
     'line': {'substep': 0.0, 'slot': 3.5, 'edge': 5.0, 'hinge': 4.6},
     'jacobi': {'substep': 0.0, 'slot': 4.0, 'edge': 2.5, 'hinge': 3.2},
     'explicit': {'substep': 0.0, 'slot': 4.0, 'edge': 2.5, 'hinge': 2.5}},
    mesh={'edge': 2.5, 'hinge': 3.8}, single=0.6)
"""of one core of a 2.6 GHz server CPU"""


@cache
def read_table(file: str) -> CostTable:
    """
    Return the table of a file.

    Raises
    ------
    InputError : no such file, another version, or entries that are missing, unknown or no times

    """
    path = Path(file)
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f'{file}: larger than {LARGEST_FILE >> 20} MiB')
        raw = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(f'{file}: {error.strerror}; write it with xpbd_ros cost --calibrate'
                         ) from None
    except (yaml.YAMLError, UnicodeDecodeError):
        raise InputError(f'{file}: is no YAML file of xpbd_ros cost --calibrate') from None
    if not isinstance(raw, dict) or 'version' not in raw:
        raise InputError(f'{file}: is no file of xpbd_ros cost --calibrate: no version')
    if raw['version'] != VERSION:
        raise InputError(f"{file}: has version {raw['version']!s:.20}, and this release reads "
                         f'{VERSION}; write it again with xpbd_ros cost --calibrate')
    _check_keys(file, '', raw, ('version', 'methods', 'mesh', 'single'), ('cpu', 'effects'))
    _check_keys(file, 'methods.', raw['methods'], METHODS)
    for method, entries in raw['methods'].items():
        _check_times(file, f'methods.{method}.', entries, NEEDED, EFFECTS)
    _check_times(file, 'mesh.', raw['mesh'], KINDS)
    _check_times(file, '', {'single': raw['single']}, ('single',))
    effects = raw.get('effects') or {}
    _check_times(file, 'effects.', effects, (), EFFECTS)
    return CostTable(raw['methods'], raw['mesh'], raw['single'], effects)


def table_text(table: CostTable, cpu: str) -> str:
    """Return the YAML text of a table."""
    raw = {'version': VERSION, 'cpu': cpu,
           'methods': {name: dict(entries) for name, entries in table.methods.items()},
           'mesh': dict(table.mesh), 'single': table.single, 'effects': dict(table.effects)}
    return '# Times on one core [ns]; read by solver.cost_table\n' + yaml.safe_dump(
        raw, sort_keys=False)


def _check_keys(file: str, where: str, given: Any, needed, further=()) -> None:
    """Raise InputError unless a mapping has the keys needed and no unknown ones."""
    if not isinstance(given, dict):
        raise InputError(f'{file}: {where.rstrip(".")}: must be a mapping')
    for key in needed:
        if key not in given:
            raise InputError(f'{file}: {where}{key}: is missing')
    for key in given:
        if key not in needed and key not in further:
            raise InputError(f'{file}: {where}{key!s:.40}: unknown key (known: '
                             f'{", ".join((*needed, *further))})')


def _check_times(file: str, where: str, given: Any, needed, further=()) -> None:
    """Raise InputError unless a mapping has finite times of at least 0, and some per slot."""
    _check_keys(file, where, given, needed, further)
    for key, value in given.items():
        least = 0.0 if key not in ('slot', 'single') else 1e-3
        if (isinstance(value, bool) or not isinstance(value, int | float)
                or not isfinite(value) or value < least):
            raise InputError(f'{file}: {where}{key}: must be a number of at least {least:g} '
                             f'(got {value!s:.40})')
