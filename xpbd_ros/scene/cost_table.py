"""
Cost of a substep by method and effect, for ``auto``: the shipped table, or one of a machine.

A substep takes

    substep + slot · slots + Σ effect · particles
    + iterations Σ kind · constraints   [ns]

on one core, with the entries of the method. A constraint's kind is the name of its effect where
the table has it, else ``edge`` (two particles) or ``hinge``, on a mesh ``mesh_edge`` or
``mesh_hinge``; one that ``line`` sweeps once counts ``SWEPT_ONCE``, but in the last of an odd
number of substeps, where it is swept both ways. An effect whose work depends on more than the
number of particles says how many it is worth (``Built.particles_worth``). ``xpbd_ros cost
--calibrate`` writes the table of a machine, and ``solver.cost_table`` reads it.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from xpbd_ros.effects import EFFECTS, load
from xpbd_ros.errors import InputError
from xpbd_ros.sim.stepping.methods import is_swept_once, METHODS

VERSION = 2
"""of the file format"""
GRID = 'grid'
"""key of ``particles_per_thread`` for the constraints of a grid"""
NEEDED = ('substep', 'slot', 'edge', 'hinge', 'mesh_edge', 'mesh_hinge')
"""entries that a table has for each method"""
SWEPT_ONCE = 0.5
"""time of constraints that ``line`` sweeps once, over that of a sweep forth and one back"""
MANY = 10_000
"""substeps that share what is done once in a frame, where their number is open"""
LEAST = {'slot': 1e-3, 'single': 1e-3}
"""smallest value of an entry, where it is not 0"""
LARGEST_FILE = 1 << 20
"""[bytes]"""


@dataclass(frozen=True)
class CostTable:
    """Times on one core [ns]."""

    methods: Mapping[str, Mapping[str, float]]
    """by method: NEEDED, and constraints by the name of their effect"""
    single: float
    """time in float32 over that in float64"""
    effects: Mapping[str, float] = field(default_factory=dict)
    """time of an effect for each particle, where it is not that of the effect's own file"""
    particles_per_thread: Mapping[str, float] = field(default_factory={GRID: 2000.0}.copy)
    """for ``threads: 0``, fewest particles with which one more thread pays: of a GRID, and in a
    scene with an effect, where it is not that of the effect's own file"""
    cpu: str = field(default='', compare=False)
    """whose times they are"""

    def for_thread(self, name: str) -> float:
        """Return the fewest particles with which one more thread pays: GRID, or an effect."""
        if name in self.particles_per_thread:
            return self.particles_per_thread[name]
        built: Any = load(name).build
        return built.particles_per_thread

    def substep_ns(self, method: str, iterations: int, effects, state, h: float = inf,
                   substeps: int = MANY) -> float:
        """Return the mean time of a scene's substeps of h [s], ``substeps`` in a frame [ns]."""
        found = 0.0
        for (section, entry), count in self.counts(
                method, iterations, effects, state, h, substeps).items():
            found += count * (self.methods[method][entry] if section == method else
                              self.effects.get(entry, effects[entry].ns_per_particle))
        return found * (self.single if state.x.dtype == np.float32 else 1.0)

    def counts(self, method: str, iterations: int, effects, state,
               h: float = inf, substeps: int = MANY) -> Counter[tuple[str, str]]:
        """
        Return how often entries count in a substep of h [s]: (method, entry), ('effects', name).

        It is the mean of a frame's ``substeps``. Constraints that ``line`` sweeps once count
        ``SWEPT_ONCE``, and 1 in the last of an odd number.
        """
        entries = self.methods[method]
        once = SWEPT_ONCE + (1.0 - SWEPT_ONCE) * (substeps % 2) / substeps
        found: Counter[Any] = Counter({(method, 'substep'): 1, (method, 'slot'): len(state.mass)})
        for name, built in effects.items():
            found['effects', name] = built.particles_worth(effects, state, substeps)
            if built.constraints is not None:
                kind = 'edge' if built.constraints.particles.shape[1] == 2 else 'hinge'
                total = len(built.constraints.particles)
                of_meshes = min(total, sum(part.particles.shape[1] for part in map(
                    _batch, built.parts) if hasattr(part, 'particles')))    # packs may have gaps
                own = name if name in entries and name not in NEEDED else None
                often: Any = iterations * (
                    once if method == 'line' and is_swept_once(built.rate, h) else 1)
                found[method, own or kind] += often * (total - of_meshes)
                found[method, own or f'mesh_{kind}'] += often * of_meshes
        return found


def _batch(part):
    return getattr(part, 'edges', part)


SHIPPED = CostTable({
    'gauss_seidel': {'substep': 3000.0, 'slot': 4.5, 'edge': 1.8, 'hinge': 4.3, 'mesh_edge': 4.5,
                     'mesh_hinge': 7.7, 'membrane': 14.0, 'volume': 12.5},
    'gauss_seidel_symmetric': {'substep': 3500.0, 'slot': 5.0, 'edge': 3.6, 'hinge': 8.6,
                               'mesh_edge': 9.0, 'mesh_hinge': 15.3, 'membrane': 28.0,
                               'volume': 25.0},
    'line': {'substep': 7000.0, 'slot': 18.5, 'edge': 3.7, 'hinge': 6.8, 'mesh_edge': 10.6,
             'mesh_hinge': 27.0, 'membrane': 29.0, 'volume': 60.0},
    'jacobi': {'substep': 3000.0, 'slot': 5.0, 'edge': 2.5, 'hinge': 3.2, 'mesh_edge': 4.0,
               'mesh_hinge': 6.5, 'membrane': 17.5, 'volume': 10.0},
    'explicit': {'substep': 4000.0, 'slot': 5.6, 'edge': 1.3, 'hinge': 4.0, 'mesh_edge': 2.2,
                 'mesh_hinge': 15.5, 'membrane': 15.0, 'volume': 30.0}}, single=0.6,
    cpu='an Intel Xeon (family 6, model 207, 2.3 GHz, AVX-512)')
"""
The entries of ``line`` and ``explicit``, and those of effects in their files, are a fit to the
shipped scenes and 40 random ones (``study.cost``), measured on a faster Xeon (family 6, model 167)
and multiplied by 1.28, by which that is faster. Those of the other methods follow from older ones
of ``line``: passes forth and back take these for what has no lines, one pass half of that.
"""


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
    _check_keys(file, '', raw, ('version', 'methods', 'single'),
                ('cpu', 'effects', 'particles_per_thread'))
    _check_keys(file, 'methods.', raw['methods'], METHODS)
    for method, entries in raw['methods'].items():
        _check_times(file, f'methods.{method}.', entries, NEEDED, EFFECTS)
    _check_times(file, '', {'single': raw['single']}, ('single',))
    effects = raw.get('effects') or {}
    _check_times(file, 'effects.', effects, (), EFFECTS)
    per_thread = raw.get('particles_per_thread', {})
    if not isinstance(per_thread, dict):    # older files hold the number of grids alone
        per_thread = {GRID: per_thread}
    _check_times(file, 'particles_per_thread.', per_thread, (), (GRID, *EFFECTS), least=1.0)
    per_thread = {**SHIPPED.particles_per_thread, **per_thread}
    cpu = f'{raw.get("cpu") or "the CPU of " + file:.100}'
    return CostTable(raw['methods'], raw['single'], effects, per_thread, cpu)


def table_text(table: CostTable, cpu: str) -> str:
    """Return the YAML text of a table."""
    raw = {'version': VERSION, 'cpu': cpu,
           'methods': {name: dict(entries) for name, entries in table.methods.items()},
           'single': table.single, 'effects': dict(table.effects),
           'particles_per_thread': dict(table.particles_per_thread)}
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


def _check_times(file: str, where: str, given: Any, needed, further=(), *,
                 least: float = 0.0) -> None:
    """Raise InputError unless a mapping has finite numbers of at least ``least`` or LEAST."""
    _check_keys(file, where, given, needed, further)
    for key, value in given.items():
        bound = LEAST.get(key, least)
        if (isinstance(value, bool) or not isinstance(value, int | float)
                or not isfinite(value) or value < bound):
            raise InputError(f'{file}: {where}{key}: must be a number of at least {bound:g} '
                             f'(got {value!s:.40})')
