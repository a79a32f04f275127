"""The results of a study so far, one per line of a file, so that it can be continued."""

from collections.abc import Iterator
from dataclasses import asdict
import json
import math
from pathlib import Path

from xpbd_ros.errors import InputError
from xpbd_ros.study.accuracy.errors import Errors
from xpbd_ros.study.accuracy.timing import Timing

FILE = 'results.jsonl'


class ResultsStore:
    """
    Errors and timings by the key of their setting, kept in a folder.

    Parameters
    ----------
    folder : new folder, or that of the same study, which then continues
    about : values that identify the study, by name

    """

    def __init__(self, folder: Path, about: dict[str, str]):
        self.errors: dict[str, Errors] = {}
        self.timings: dict[str, Timing] = {}
        self.continued = folder.exists()
        self._file = folder / FILE
        if self.continued:
            lines = list(_lines(folder, self._file))
            _compare(folder, lines, about)
            for line in lines[1:]:
                if 'errors' in line:
                    self.errors[line['setting']] = _errors(line['errors'])
                else:
                    self.timings[line['setting']] = Timing(**line['timing'])
        else:
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise InputError(f'{folder}: cannot be created ({error.strerror})') from error
            lines = [{'study': about}]
        part = self._file.with_suffix('.part')    # drops an incomplete last line
        part.write_text(''.join(f'{json.dumps(line)}\n' for line in lines), encoding='utf-8')
        part.replace(self._file)

    def add_errors(self, key: str, found: Errors) -> None:
        """Store the errors of a setting."""
        self.errors[key] = found
        self._append({'setting': key, 'errors': _null(asdict(found))})

    def add_timing(self, key: str, found: Timing) -> None:
        """Store the timing of a setting."""
        self.timings[key] = found
        self._append({'setting': key, 'timing': asdict(found)})

    def _append(self, line: dict) -> None:
        with self._file.open('a', encoding='utf-8') as file:
            file.write(f'{json.dumps(line)}\n')


def _lines(folder: Path, file: Path) -> Iterator[dict]:
    """Yield the complete lines of a results file."""
    try:
        text = file.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError):
        raise InputError(f'{folder}: exists already, and holds no study; name another '
                         'folder') from None
    for line in text.splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            return


def _compare(folder: Path, lines: list[dict], about: dict[str, str]) -> None:
    """Refuse a folder that holds another study."""
    before = lines[0].get('study') if lines else None
    if not isinstance(before, dict):
        raise InputError(f'{folder / FILE}: is not the results file of a study; name another '
                         'folder')
    other = [name for name, value in about.items() if before.get(name) != value]
    if other:
        raise InputError(f'{folder}: holds a study with another {" and ".join(other)}; name '
                         'another folder')


def _null(value):
    """Return plain data with None for non-finite numbers."""
    if isinstance(value, dict):
        return {key: _null(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_null(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _errors(found: dict) -> Errors:
    """Return stored errors, with NaN for None."""
    def number(value):
        if isinstance(value, list):
            return tuple(number(item) for item in value)
        return math.nan if value is None else value
    return Errors(**{name: value if name == 'residual_m' else number(value)
                     for name, value in found.items()})
