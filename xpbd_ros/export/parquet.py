"""
Tables for pandas, Polars or DuckDB: ``particles.parquet``, and ``pins.parquet`` if pins held, and
``colliders.parquet`` if there were colliders.

Columns are frame, time_s, then cloth, particle, x, y, z [m]; or pin or collider, its pose, and the
force [N] and torque [N m] of the cloth on it. A row group holds about ROWS rows.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.export.states import State, States

ROWS = 2**18
"""rows in memory at a time"""
BODY_COLUMNS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'force_x', 'force_y', 'force_z', 'torque_x',
                'torque_y', 'torque_z')


def write(folder: Path, states: States, frames: Callable[[], Iterable[State]]) -> list[Path]:
    """Write the tables, and return their paths."""
    try:
        import pyarrow
    except ImportError as error:
        raise InputError(f'--format parquet needs pyarrow ({error}); pip install '
                         "'xpbd_ros[export]' (or apt install python3-pyarrow)") from None
    stamp = [('frame', pyarrow.int64()), ('time_s', pyarrow.float64())]
    names = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
    particles = _Table(folder / 'particles.parquet', pyarrow.schema([
        *stamp, ('cloth', names), ('particle', pyarrow.int32()),
        *((axis, pyarrow.float32()) for axis in 'xyz')]))
    bodies = {what: _Table(folder / f'{what}s.parquet', pyarrow.schema([
        *stamp, (what, names), *((name, pyarrow.float64()) for name in BODY_COLUMNS)]))
        for what in ('pin', 'collider')}
    try:
        for state in frames():
            for cloth, positions in state.positions.items():
                count = len(positions)
                particles.add(count, [np.full(count, state.frame), np.full(count, state.time_s),
                                      [cloth] * count, np.arange(count, dtype=np.int32),
                                      *positions.T])
            for what, found in (('pin', state.pins), ('collider', state.colliders)):
                if found:
                    count = len(found)
                    rows = np.array([(*each.position, *each.orientation, *each.force,
                                      *each.torque) for each in found])
                    bodies[what].add(count, [
                        np.full(count, state.frame), np.full(count, state.time_s),
                        [each.name for each in found], *rows.T])
    finally:
        for table in (particles, *bodies.values()):
            table.close()
    return [table.path for table in (particles, *bodies.values()) if table.path.exists()]


class _Table:
    """A Parquet file that is created with its first rows."""

    def __init__(self, path: Path, schema):
        self.path = path
        self._schema = schema
        self._writer: Any = None
        self._batches: list = []
        self._rows = 0

    def add(self, count: int, columns: list) -> None:
        """Add rows."""
        import pyarrow
        self._batches.append(pyarrow.record_batch(
            [pyarrow.array(column, field.type) for column, field in zip(columns, self._schema)],
            schema=self._schema))
        self._rows += count
        if self._rows >= ROWS:
            self._flush()

    def _flush(self) -> None:
        import pyarrow
        from pyarrow import parquet
        if not self._batches:
            return
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self.path, self._schema, compression='zstd')
        self._writer.write_table(pyarrow.Table.from_batches(self._batches).unify_dictionaries(),
                                 row_group_size=ROWS)
        self._batches, self._rows = [], 0

    def close(self) -> None:
        """Write the remaining rows."""
        self._flush()
        if self._writer is not None:
            self._writer.close()
