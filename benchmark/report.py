"""What a run of the benchmark says and collects."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TextIO

import numpy as np

from checks import WrongResultError
from native import Native, NotAvailableError
from timing import interleave, Timed


@dataclass
class Report:
    """Prints lines as they come, and keeps what goes into the JSON."""

    out: TextIO
    native: Native
    rounds: int
    seconds: float
    """that one candidate runs for in one round"""
    goal: float
    """error of the swing [m] for which the textbook's time is asked"""
    data: dict = field(default_factory=lambda: {
        'rows': [], 'swing': [], 'swing_goals': [], 'scaling': [], 'exponents': [],
        'not_available': [], 'wrong': []})

    def say(self, text: str = '') -> None:
        """Print a line at once."""
        print(text, file=self.out, flush=True)

    def attempt(self, what: str, make: Callable, *arguments):
        """Return what ``make`` makes of the arguments; None where there is nothing to measure."""
        try:
            return make(*arguments)
        except NotAvailableError as error:
            self._leave_out('not_available', what, f'not available: {error}')
        except WrongResultError as error:
            self._leave_out('wrong', what, f'WRONG, not timed: {error}')
        return None

    def _leave_out(self, key: str, what: str, why: str) -> None:
        """Say it once: not of every table that there is no compiler."""
        known = self.data[key]
        general = any(entry['why'] == why and entry['what'] in ('textbook', 'bound')
                      for entry in known)
        if not general and {'what': what, 'why': why} not in known:
            known.append({'what': what, 'why': why})
            self.say(f'  {what:32} {why}')


class Table:
    """
    The candidates for one work, which take turns.

    A candidate may take one direction of two; then the mean of both is a row of its own.
    """

    def __init__(self, report: Report, what: str, n: int, precision: str):
        self.report, self.what, self.n, self.precision = report, what, n, precision
        self.entries: list[tuple[str, str, int]] = []    # method, direction, threads
        self.timed: list[Timed] = []
        report.say(f'\n{what}, n = {n}, {precision}')

    def add(self, method: str, make: Callable[..., Timed], *arguments, direction: str = '',
            threads: int = 1) -> None:
        """Add what ``make`` makes of this table and the arguments, if it passes its check."""
        timed = self.report.attempt(_name(method, direction, threads), make, self, *arguments)
        if timed is not None:
            self.entries.append((method, direction, threads))
            self.timed.append(timed)

    def measure(self) -> None:
        """Time all candidates, print the table and add its rows to the report."""
        found = interleave(self.timed, rounds=self.report.rounds, seconds=self.report.seconds)
        ns = dict(zip(self.entries, 1e9 * found))
        for method, direction, threads in self.entries:
            both = [ns.get((method, way, threads)) for way in ('across', 'along')]
            if direction and all(way is not None for way in both):
                ns[method, '', threads] = np.mean(both, axis=0)
        if ns:
            self.report.say(f"  {'':32} {'ns':>7} {'fastest':>8} {'slowest':>8} "
                            f"{'speed-up':>9} {'of bound':>9}")
        for (method, direction, threads), times in ns.items():
            beside = {key[0]: value for key, value in ns.items() if key[1:] == (direction, 1)}
            bounds = [value for name, value in beside.items() if name.startswith('bound')]
            limit = min(bounds, key=np.median, default=None)
            textbook = beside.get('textbook')
            row = {
                'what': self.what, 'method': f'{method} {direction}'.strip(),
                'precision': self.precision, 'n': self.n, 'threads': threads,
                'ns_per_projection': float(np.median(times)),
                'ns_min': float(times.min()), 'ns_max': float(times.max()),
                'ratio_to_textbook': None if textbook is None
                else float(np.median(textbook / times)),
                'ratio_to_limit': None if limit is None else float(np.median(times / limit))}
            self.report.data['rows'].append(row)
            self.report.say(
                f'  {_name(method, direction, threads):32} {row["ns_per_projection"]:7.2f} '
                f'{row["ns_min"]:8.2f} {row["ns_max"]:8.2f} '
                f'{_times(row["ratio_to_textbook"])} {_times(row["ratio_to_limit"])}')


def _name(method: str, direction: str, threads: int) -> str:
    return ' '.join(filter(None, (method, direction, f'({threads} threads)' * (threads > 1))))


def _times(ratio: float | None) -> str:
    return f'{"":>9}' if ratio is None else f'{ratio:8.2f}x'
