"""The change of a running simulation when a live key of its scene is set."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from xpbd_ros.errors import InputError
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


def in_valid_order(changes: dict[str, Any],
                   check: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """
    Return changes in an order in which the scene is valid after each; the given one, if it is.

    Keys may bound one another, as ``friction`` and ``static_friction`` do. ``check`` raises
    InputError for bad changes, and accepts all of these together.
    """
    left = list(changes)
    found: dict[str, Any] = {}
    while left:
        for key in left:
            try:
                check({**found, key: changes[key]})
                break
            except InputError:
                continue
        left.remove(key)
        found[key] = changes[key]
    return found
