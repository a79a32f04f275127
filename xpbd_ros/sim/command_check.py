"""Checks of commands: finite numbers within ``FAR``, unit quaternions, known shapes."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from math import inf, isfinite, sqrt
import reprlib
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import (
    Click,
    Command,
    Grasp,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    RemoveCollider,
    SetKey,
    SetState,
    SetWind,
    Twist,
    Vector,
)

FAR = 1e6
"""largest coordinate, size and speed that is accepted [m, m/s, rad/s]"""
LATEST = 2**31 * 10**9
"""first time that no ROS message holds [ns]"""
SIZES = {'box': 3, 'sphere': 1, 'cylinder': 2}
"""count of numbers in the size of each shape of ``PlaceCollider`` but a mesh"""


def checked(command: Command) -> Command:
    """
    Return a command with tuples for its vectors and a normalized quaternion.

    Raises
    ------
    InputError : not a command, or a field is not finite, beyond ``FAR`` or of the wrong length

    """
    check = CHECKS.get(type(command))
    if check is None:
        if not isinstance(command, Command):
            raise InputError(f'{command!r} is not a command such as MovePin or SetKey')
        return command
    what = f'{type(command).__name__} {_name(command)}'.rstrip()
    try:
        changes = check(command, what)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f'{what}: a value is not a number ({error})') from None
    if all(value is getattr(command, key) for key, value in changes.items()):
        return command
    return replace(command, **changes)


def _name(command: Command) -> str:
    name = (getattr(command, 'pin', None) or getattr(command, 'collider', None)
            or getattr(command, 'cloth', ''))
    if not isinstance(name, str):
        raise InputError(f'{type(command).__name__}: {name!r} is not a name')
    return name


def _move(command: MovePin | MoveCollider, what: str) -> dict[str, Any]:
    return {'pose': checked_pose(command.pose, what),
            'stamp_ns': _time(command.stamp_ns, what, 'stamp_ns'),
            'twist': None if command.twist is None else checked_twist(command.twist, what)}


def _grasp(command: Grasp, what: str) -> dict[str, Any]:
    if not 0.0 < command.radius < inf:
        raise InputError(f'{what}: radius must be > 0 m (got {command.radius})')
    return {'pose': checked_pose(command.pose, what), 'radius': float(command.radius),
            'lifetime_ns': _time(command.lifetime_ns, what, 'lifetime_ns')}


def _place(command: PlaceCollider, what: str) -> dict[str, Any]:
    lifetime_ns = _time(command.lifetime_ns, what, 'lifetime_ns')
    size, shape = command.size, command.shape
    if shape == 'mesh':
        size = numbers(size, len(size) // 9 * 9 or 9, what, 'corners of the triangles')
        if not all(-FAR <= c <= FAR for c in size):
            raise InputError(f'{what}: a corner is further than {FAR:g} m away, or not finite')
    elif shape not in SIZES:
        raise InputError(f'{what}: unknown shape {shape!r} (known: {", ".join(SIZES)}, mesh)')
    else:
        size = numbers(size, SIZES[shape], what, f'size of a {shape}')
        if not all(0.0 < c <= 2.0 * FAR for c in size):
            raise InputError(f'{what}: size {list(size)} must be > 0 m and no more than '
                             f'{2.0 * FAR:g}')
    return {'pose': checked_pose(command.pose, what), 'size': size,
            'lifetime_ns': lifetime_ns}


def _wind(command: SetWind, what: str) -> dict[str, Any]:
    return {'velocity': checked_velocity(command.velocity, f'{what}: velocity')}


def _set_key(command: SetKey, what: str) -> dict[str, Any]:
    if not isinstance(command.key, str):
        raise InputError(f"{what}: {command.key!r} is not a key such as 'solver.substeps'")
    return {'value': plain(command.value)}


def _click(command: Click, what: str) -> dict[str, Any]:
    return {'point': checked_point(command.point, f'{what}: point')}


def _set_state(command: SetState, what: str) -> dict[str, Any]:
    places: Any = command.positions
    shape = np.shape(places)
    if len(shape) == 2 and shape[1] == 3:
        places = tuple(np.asarray(places, float).ravel().tolist())
    elif len(shape) != 1 or len(places) % 3:
        raise InputError(f'{what}: positions must be x, y, z of each particle, of shape '
                         f'(particles, 3) or flat (got {shape})')
    places = numbers(places, len(places), what, 'positions')
    if not all(-FAR <= c <= FAR for c in places):
        raise InputError(f'{what}: a position is further than {FAR:g} m away, or not finite')
    return {'positions': places}


CHECKS: dict[type, Callable[[Any, str], dict[str, Any]]] = {
    MovePin: _move, MoveCollider: _move, Grasp: _grasp, PlaceCollider: _place, SetWind: _wind,
    Click: _click, SetState: _set_state, SetKey: _set_key,
    Release: lambda command, what: {}, RemoveCollider: lambda command, what: {}}
"""check of each kind of command: returns its fields as they are to be used"""


def plain(value: Any) -> Any:
    """Return a value of a key with NumPy's scalars and arrays as numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {plain(key): plain(each) for key, each in value.items()}
    if type(value) in (list, tuple):
        found = type(value)(map(plain, value))
        return value if all(a is b for a, b in zip(found, value)) else found
    return value


def _time(time: int, what: str, key: str) -> int:
    if not isinstance(time, int | np.integer) or time < 0:
        raise InputError(f'{what}: {key} must be an integer >= 0 ns (got {time!r})')
    if time >= LATEST:
        raise InputError(f'{what}: {key} must be below 2**31 s, the most that ROS has')
    return int(time)


def checked_pose(pose: Pose, what: str) -> Pose:
    """Return a pose with a normalized quaternion; raise InputError for a bad one."""
    if not isinstance(pose, Pose):
        raise InputError(f'{what}: {pose!r} is not a Pose')
    p = numbers(pose.position, 3, what, 'position')
    q = numbers(pose.orientation, 4, what, 'orientation')
    if not isfinite(sum(p) + sum(q)):
        raise InputError(f'{what}: position or orientation is not finite')
    if max(map(abs, p)) > FAR:
        raise InputError(f'{what}: position {list(p)} is further than {FAR:g} m away')
    square = sum(c * c for c in q)
    if not 0.8 < square < 1.2:
        raise InputError(f'{what}: orientation {list(q)} is not a unit quaternion')
    if abs(square - 1.0) > 1e-12:
        q = tuple(c / sqrt(square) for c in q)
    return pose if p is pose.position and q is pose.orientation else Pose(p, q)


def checked_twist(twist: Twist, what: str) -> Twist:
    """Return a twist; raise InputError if it is not finite or faster than ``FAR``."""
    if not isinstance(twist, Twist):
        raise InputError(f'{what}: {twist!r} is not a Twist')
    linear = numbers(twist.linear, 3, what, 'linear')
    angular = numbers(twist.angular, 3, what, 'angular')
    if not isfinite(sum(linear) + sum(angular)):
        raise InputError(f'{what}: twist is not finite')
    if max(map(abs, linear + angular)) > FAR:
        raise InputError(f'{what}: twist {list(linear)}, {list(angular)} is faster than {FAR:g}')
    return (twist if linear is twist.linear and angular is twist.angular
            else Twist(linear, angular))


def checked_point(point: Iterable[float], what: str) -> Vector:
    """Return a position [m]; raise InputError if it is not finite or beyond ``FAR``."""
    place: Vector = numbers(point, 3, what, 'coordinates')
    if not all(-FAR <= c <= FAR for c in place):
        raise InputError(f'{what} {list(place)} is not finite, or further than {FAR:g} m away')
    return place


def checked_velocity(velocity: Iterable[float], what: str) -> Vector:
    """Return a velocity [m/s]; raise InputError if it is not finite or faster than ``FAR``."""
    vector: Vector = numbers(velocity, 3, what, 'vector')
    if not isfinite(sum(vector)):
        raise InputError(f'{what} is not finite')
    if max(map(abs, vector)) > FAR:
        raise InputError(f'{what} {list(vector)} is faster than {FAR:g} m/s')
    return vector


def numbers(values: Iterable[float], count: int, what: str, key: str) -> Any:
    """Return values as a tuple of ``count`` items; raise InputError for another count."""
    found = values if isinstance(values, tuple) else tuple(map(float, values))
    if len(found) != count:
        raise InputError(f'{what}: {key} must be {count} numbers (got {reprlib.repr(values)})')
    return found
