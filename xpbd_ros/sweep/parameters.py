"""The values of a sweep's keys: rows of a CSV file, or random draws from ranges."""

from collections.abc import Sequence
import csv
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np

from xpbd_ros.errors import counted, InputError
from xpbd_ros.scene.load import load_scene, parse_yaml
from xpbd_ros.scene.model import Scene

LOG = 'log'
Overrides = dict[str, Any]
"""values by dotted key"""


@dataclass(frozen=True)
class Range:
    """A key, and the range that its values are drawn from."""

    key: str
    low: float
    high: float
    log: bool = False
    """True if the logarithm is uniform instead of the value"""

    @classmethod
    def parse(cls, text: str) -> 'Range':
        """Return the range in ``KEY=LOW:HIGH`` or ``KEY=LOW:HIGH:log``."""
        key, equals, values = text.partition('=')
        parts = values.split(':')
        form = f'--vary {text}: must be KEY=LOW:HIGH or KEY=LOW:HIGH:log'
        if not (equals and key) or len(parts) not in (2, 3) or parts[2:] not in ([], [LOG]):
            raise InputError(form)
        try:
            low, high = (float(part) for part in parts[:2])
        except ValueError:
            raise InputError(form) from None
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f'--vary {text}: LOW must be less than HIGH, and both finite')
        if len(parts) == 3 and low <= 0.0:
            raise InputError(f'--vary {text}: with log, LOW must be > 0')
        return cls(key, low, high, len(parts) == 3)

    def __str__(self) -> str:
        """Return the text that ``parse`` reads."""
        return f'{self.key}={self.low:.17g}:{self.high:.17g}' + f':{LOG}' * self.log

    def value(self, part: float) -> float:
        """Return the value at a part of the range, from 0 to 1."""
        if self.log:
            return float(self.low * (self.high / self.low)**part)
        return float(self.low + part * (self.high - self.low))


def draw(ranges: Sequence[Range], runs: int, seed: int) -> list[Overrides]:
    """
    Return random values for each run.

    A run's values depend on the seed and its number alone, so that more runs continue a sweep.
    """
    return [{each.key: each.value(part) for each, part in zip(
        ranges, np.random.default_rng([seed, run]).random(len(ranges)))} for run in range(runs)]


def read_table(file: str) -> list[Overrides]:
    """
    Return the values of each row of a CSV file, whose columns are dotted keys.

    Values are YAML, as those of ``--set``. An empty cell leaves the key as the scene has it.

    Raises
    ------
    InputError : with file, line and column

    """
    try:
        with Path(file).open(newline='', encoding='utf-8-sig') as text:
            reader = csv.reader(text)
            rows = [(reader.line_num, row) for row in reader if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f'{file}: cannot be read as CSV ({reason})') from None
    if len(rows) < 2:
        raise InputError(f'{file}: must hold a row of keys, and a row of values for each run')
    keys = [cell.strip() for cell in rows[0][1]]
    for k, key in enumerate(keys):
        if not key or key in keys[:k]:
            raise InputError(f'{file}: column {k + 1}: '
                             + (f"'{key}' is given twice" if key else 'has no key'))
    found = []
    for line, row in rows[1:]:
        if len(row) != len(keys):
            raise InputError(f'{file}: line {line}: {counted(len(row), "value")} for '
                             f'{counted(len(keys), "key")}')
        found.append({key: parse_yaml(cell, f'{file}: line {line}: {key}')
                      for key, cell in zip(keys, row) if cell.strip()})
    return found


def whole_numbers(name: str, ranges: Sequence[Range], base: Overrides) -> set[str]:
    """Return the keys of ranges that take whole numbers only, such as ``solver.substeps``."""
    return {each.key for each in ranges if 'must be a whole number' in (
        refusal(name, {**base, each.key: each.value(1.0 / math.pi)}) or '')}


def refusal(name: str, overrides: Overrides) -> str | None:
    """Return why a scene refuses overrides; None if it does not."""
    scene = scene_or_reason(name, overrides)
    return scene if isinstance(scene, str) else None


def scene_or_reason(name: str, overrides: Overrides) -> Scene | str:
    """Return a scene with overrides, or why it refuses them."""
    try:
        return load_scene(name, overrides)
    except InputError as error:
        return str(error)


def check_keys(name: str, runs: Sequence[Overrides], base: Overrides) -> None:
    """Raise InputError if a key, on its own, is refused with each of its values."""
    for key in dict.fromkeys(key for run in runs for key in run):
        reason = None
        for run in runs:
            if key in run:
                reason = refusal(name, {**base, key: run[key]})
                if reason is None:
                    break
        if reason is not None:
            raise InputError(f'{reason} (every value of {key} is refused)')
