"""The change of a running simulation when a live key of its scene is set."""

from dataclasses import dataclass
from typing import Any, Protocol

from xpbd_ros.sim.effect import Built
from xpbd_ros.sim.particles.state import State
from xpbd_ros.sim.stepping.solver import Solver


@dataclass(frozen=True)
class Change:
    """New effects, solver setting and gravity, after a live key was set."""

    effects: dict[str, Built]
    solver: Solver | None = None
    gravity: tuple[float, float, float] | None = None


class Retune(Protocol):
    """Compute what a new value of a live key changes, as ``scene.compile.Retune`` does."""

    def __call__(self, key: str, value: Any) -> Change:
        """Return the change; raise InputError for a bad value."""

    def check(self, changes: dict[str, Any]) -> object:
        """Raise InputError for bad keys or values; change nothing."""

    def rebind(self, state: State, effects: dict[str, Built]) -> None:
        """Continue with another state and effects of the same scene."""
