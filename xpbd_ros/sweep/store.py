"""The rows of a sweep: a file for each until all are there, then one Parquet table."""

from collections.abc import Sequence
import json
import os
from pathlib import Path
import shutil
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.sweep.outcome import ERROR, Row

ABOUT, TABLE, ROWS, LOGS = 'sweep.json', 'sweep.parquet', 'rows', 'logs'
"""names in the folder of a sweep"""
LOST = 'the worker was killed'
"""start of the error of a run whose workers were killed; it is repeated when the sweep goes on"""


def need_pyarrow():
    """Return the Parquet library; raise InputError with a remedy if it cannot be imported."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError(f"'sweep' needs pyarrow ({error}); pip install "
                         "'xpbd_ros[cluster]' (or apt install python3-pyarrow)") from None
    return pyarrow, parquet


class Store:
    """
    The folder of a sweep.

    Parameters
    ----------
    folder : new folder, or that of the same sweep, which then continues
    about : values that identify the sweep, by name

    Raises
    ------
    InputError : the folder cannot be created, or holds something else

    """

    def __init__(self, folder: Path, about: dict[str, Any]):
        self.folder = folder.absolute()
        self.table = self.folder / TABLE
        about = json.loads(json.dumps(about))
        self._new = not os.path.lexists(folder)
        if not self._new:
            self._compare(about)
        else:
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise InputError(f'{folder}: cannot be created ({error.strerror})') from error
            _replace(self.folder / ABOUT, json.dumps(about, indent=2) + '\n')
        self.rows = {run: row for run, row in self._found().items()
                     if not (row.get(ERROR) or '').startswith(LOST)}
        """rows so far, by run"""

    def _compare(self, about: dict[str, Any]) -> None:
        """Refuse a folder that holds another sweep or none."""
        try:
            before = json.loads((self.folder / ABOUT).read_text(encoding='utf-8'))
            other = [name for name, value in about.items() if before.get(name) != value]
        except (OSError, ValueError, AttributeError):
            raise InputError(f'{self.folder}: exists already, and holds no sweep; name another '
                             'folder') from None
        if other:
            raise InputError(f'{self.folder}: holds a sweep that differs in its '
                             f'{" and ".join(other)}; name another folder')

    def _found(self) -> dict[int, Row]:
        """Return the rows of the table and of single files."""
        found: dict[int, Row] = {}
        if self.table.exists():
            _, parquet = need_pyarrow()
            for row in parquet.read_table(self.table).to_pylist():
                found[row['run']] = row
        for file in sorted((self.folder / ROWS).glob('*.json')):
            row = json.loads(file.read_text(encoding='utf-8'))
            found[row['run']] = row
        return found

    def log(self, run: int) -> Path:
        """Return the folder of a run's log."""
        return self.folder / LOGS / f'{run:06}'

    def add(self, run: int, keys: Row, found: Row) -> None:
        """Store the row of a run: the values of its keys, and its outcome."""
        (self.folder / ROWS).mkdir(exist_ok=True)
        row = self.rows[run] = {'run': run, **keys, ERROR: None, **found}
        _replace(self.folder / ROWS / f'{run:06}.json', json.dumps(row) + '\n')

    def join(self) -> Path:
        """Write the table, remove the files of single rows, and return its path."""
        pyarrow, parquet = need_pyarrow()
        rows = [self.rows[run] for run in sorted(self.rows)]
        longest = max(rows, key=len, default={})
        names = dict.fromkeys([*longest, *(name for row in rows for name in row)])
        table = pyarrow.table({name: _column(pyarrow, name, [row.get(name) for row in rows])
                               for name in names})
        part = self.table.with_suffix('.part')
        parquet.write_table(table, part, compression='zstd')
        part.replace(self.table)
        shutil.rmtree(self.folder / ROWS, ignore_errors=True)
        return self.table

    def discard_if_empty(self) -> None:
        """Remove a folder that was created here and has no row."""
        if self._new and not self.rows:
            shutil.rmtree(self.folder)


def _column(pyarrow, name: str, values: Sequence) -> Any:
    """Return a column; values of several types, and lists, become text."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {int, float}:
        values = [value if value is None else float(value) for value in values]
    elif len(kinds) > 1 or kinds & {list, dict}:
        values = [value if value is None or isinstance(value, str) else json.dumps(value)
                  for value in values]
    empty = None if kinds else pyarrow.float64()
    return pyarrow.array(values, pyarrow.string() if name == ERROR else empty)


def _replace(file: Path, text: str) -> None:
    """Write a file at once: a reader finds all of the text, or none."""
    part = file.with_suffix('.part')
    part.write_text(text, encoding='utf-8')
    part.replace(file)
