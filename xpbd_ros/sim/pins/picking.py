"""The particles that grasps and clicks take, and why commands of pins are refused."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
import itertools

import numpy as np

from xpbd_ros.sim.commands import Click, Command, Grasp, MovePin, Release, ReleaseAll
from xpbd_ros.sim.geometry.mesh import length
from xpbd_ros.sim.particles.state import places, State


def unused_name(names: Collection[str]) -> str:
    """Return the name of a new clicked pin: the first of clicked_0, clicked_1, … not in use."""
    return next(name for k in itertools.count() if (name := f'clicked_{k}') not in names)


def nearest_particle(command: Click, state: State) -> tuple[int, float]:
    """Return the slot of the particle nearest to a click, and its distance [m]."""
    distance = length(places(state.x) - command.point)
    distance[state.mass == 0.0] = np.inf    # padding
    nearest = int(distance.argmin())
    return nearest, float(distance[nearest])


def within(command: Grasp, taken: np.ndarray, state: State) -> tuple[np.ndarray, float]:
    """
    Return the slots that a grasp takes, and the distance to the nearest free particle [m].

    Parameters
    ----------
    command : the grasp
    taken : which slots hold a held particle or padding, shape (slots,)
    state : of the particles

    """
    distance = length(places(state.x) - command.pose.position)
    distance[taken] = np.inf
    return np.flatnonzero(distance <= command.radius), float(distance.min())


@dataclass
class Picking:
    """
    The pins as they will be while commands of one message are applied, one after another.

    ``refusal`` returns why a command cannot be applied, or notes what it changes.
    """

    holds: dict[str, np.ndarray]
    """slots of each active pin"""
    taken: np.ndarray
    """which slots hold a held particle or padding, shape (slots,)"""
    entries: Mapping[str, object]
    """pins of the scene"""
    capacity: int
    """most pins at a time"""
    click_radius: float
    """[m]"""

    def refusal(self, commands: Sequence[Command], state: State) -> str | None:
        """Return why these commands cannot all be applied, in this order."""
        for command in commands:
            reason = self._refusal(command, state)
            if reason is not None:
                return reason
        return None

    def _refusal(self, command, state: State) -> str | None:
        if isinstance(command, ReleaseAll):
            for name in list(self.holds):
                self._release(name)
        elif isinstance(command, Click):
            return self._click(command, state)
        elif isinstance(command, Grasp):
            return self._grasp(command, state)
        elif command.pin not in self.holds and not (
                isinstance(command, MovePin) and command.pin in self.entries):
            return (f"pin '{command.pin}' holds nothing (holding: "
                    f'{", ".join(self.holds) or "none"})')
        elif isinstance(command, Release):
            self._release(command.pin)
        return None

    def _release(self, name: str) -> None:
        self.taken[self.holds.pop(name)] = False

    def _hold(self, name: str, particles: np.ndarray) -> None:
        self.holds[name], self.taken[particles] = particles, True

    @property
    def _full(self) -> str | None:
        """Return the reason why there can be no further pin, if so."""
        if len(self.holds) < self.capacity:
            return None
        return f'all {len(self.holds)} pins are in use (effects.pin.max_pins)'

    def _grasp(self, command: Grasp, state: State) -> str | None:
        if command.pin in self.holds:
            return None
        if self._full:
            return self._full
        near, nearest = within(command, self.taken, state)
        if nearest == np.inf:
            return f"pin '{command.pin}': no particle is free; pins hold all of them"
        if not len(near):
            return (f"pin '{command.pin}': no free particle within {command.radius:g} m "
                    f'of {[round(c, 4) for c in command.pose.position]}; the nearest is '
                    f'{nearest:.3g} m away')
        self._hold(command.pin, near)
        return None

    def _click(self, command: Click, state: State) -> str | None:
        nearest, distance = nearest_particle(command, state)
        if distance > self.click_radius:
            return (f'no particle within {self.click_radius:g} m of '
                    f'{[round(c, 4) for c in command.point]}; the nearest is {distance:.3g} m '
                    'away')
        holder = next((name for name, these in self.holds.items() if nearest in these), None)
        if holder is not None:
            self._release(holder)
        elif self._full:
            return self._full
        else:
            self._hold(unused_name((*self.holds, *self.entries)), np.array([nearest]))
        return None
