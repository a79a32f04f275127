"""What a hard case is: what is tried, at which setting, and what came of it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Setting:
    """How a case is solved."""

    method: str = 'line'
    integrator: str = 'bdf2'
    substeps: int = 8
    iterations: int = 1
    precision: str = 'float64'

    def __str__(self) -> str:
        """Return it in a few words."""
        text = f'{self.method} {self.integrator} {self.substeps}x{self.iterations}'
        return text + (f' {self.precision}' if self.precision != 'float64' else '')

    @property
    def keys(self) -> dict:
        """The ``solver`` section of a scene."""
        return dict(vars(self))


@dataclass(frozen=True)
class Outcome:
    """What came of one attempt."""

    setting: str
    good: bool
    finite: bool | None = None
    """None where it was refused at the door"""
    strain_max: float | None = None
    energy_rise: float | None = None
    """of the total energy over that at the start, in parts of what the cloth can have"""
    recovered: bool | None = None
    """None where there is nothing to recover from"""
    recovery_s: float | None = None
    """after the cause ended [s]"""
    reported: str = ''
    """what the user is told"""
    why: str = ''
    """what it missed"""
    textbook: bool | None = None
    """whether a textbook solver meets the same; None where it has nothing of the kind"""
    textbook_why: str = ''
    skipped: bool = False


class Attempt(Protocol):
    """One run, or one refusal."""

    def outcome(self) -> Outcome:
        """Do it."""


@dataclass(frozen=True)
class Hard:
    """One case: ``attempts()`` says what is tried."""

    id: str
    title: str
    family: str
    attempts: Callable[[], Iterable[Attempt]]
    slow: bool = False


HARD: list[Hard] = []


def hard(id_: str, title: str, *, slow: bool = False):
    """Register a function that yields attempts."""
    def register(attempts):
        HARD.append(Hard(id_, title, attempts.__module__.rpartition('.')[2], attempts, slow))
        return attempts
    return register
