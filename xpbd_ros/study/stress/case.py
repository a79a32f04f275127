"""Hard cases: solver setting, outcome, and the registry of cases."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

NONE_SET = 'no setting'
"""column of refusals and node cases"""


@dataclass(frozen=True)
class Setting:
    """A solver setting."""

    method: str = 'line'
    integrator: str = 'bdf2'
    substeps: int = 8
    iterations: int = 1
    precision: str = 'float64'

    def __str__(self) -> str:
        """Return the setting as text, such as 'line bdf2 8x1'."""
        text = f'{self.method} {self.integrator} {self.substeps}x{self.iterations}'
        return text + (f' {self.precision}' if self.precision != 'float64' else '')

    @property
    def keys(self) -> dict:
        """The ``solver`` section of a scene."""
        return dict(vars(self))


@dataclass(frozen=True)
class Outcome:
    """The result of one attempt."""

    setting: str
    """name of the attempt: its setting and its label"""
    good: bool
    """True if the attempt met all criteria"""
    finite: bool | None = None
    """True if all numbers stayed finite; None for a refused scene"""
    strain_max: float | None = None
    """largest strain of an edge"""
    energy_rise: float | None = None
    """largest rise of the total energy over that at the start, over the energy scale"""
    recovered: bool | None = None
    """True if the strain recovered; None if the case does not ask for that"""
    recovery_s: float | None = None
    """time from the end of the cause to recovery [s]"""
    reported: str = ''
    """messages to the user"""
    why: str = ''
    """criteria that it missed; empty if it passed"""
    textbook: bool | None = None
    """True if the textbook solver meets the criteria; None if it lacks an effect of the case"""
    textbook_why: str = ''
    """criteria that the textbook solver missed"""
    skipped: bool = False
    """True if the case was not run"""
    column: str = NONE_SET
    """its solver setting"""


class Attempt(Protocol):
    """One run, or one scene that must be refused."""

    def outcome(self) -> Outcome:
        """Run the attempt and return its result."""


@dataclass(frozen=True)
class HardCase:
    """One case; ``attempts()`` returns its attempts."""

    id: str
    title: str
    family: str
    attempts: Callable[[], Iterable[Attempt]]
    slow: bool = False


CASES: list[HardCase] = []


def hard(id_: str, title: str, *, slow: bool = False):
    """Return a decorator that registers a function, which yields attempts, as a case."""
    def register(attempts):
        CASES.append(HardCase(id_, title, attempts.__module__.rpartition('.')[2], attempts, slow))
        return attempts
    return register
