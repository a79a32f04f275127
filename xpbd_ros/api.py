"""
The Python API: what ``import xpbd_ros`` offers. No ROS is needed.

Everything else in the package may change without notice.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
from typing import Any, TypeVar

from xpbd_ros.errors import brief, InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.sim.command_check import plain
from xpbd_ros.sim.commands import (
    Click,
    Command,
    Grasp,
    LoadState,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
    Release,
    ReleaseAll,
    RemoveAllColliders,
    RemoveCollider,
    Reset,
    SaveState,
    SetKey,
    SetState,
    SetWind,
    Twist,
)
from xpbd_ros.sim.simulation import Frame, SavedState as State, Simulation

__all__ = [
    'Click', 'Frame', 'Grasp', 'InputError', 'LoadState', 'MoveCollider', 'MovePin',
    'PlaceCollider', 'Pose', 'Release', 'ReleaseAll', 'RemoveAllColliders', 'RemoveCollider',
    'Reset', 'SaveState', 'SetKey', 'SetState', 'SetWind', 'Simulation', 'State', 'Twist', 'load',
    'rollouts']

Result = TypeVar('Result')
_recordings: list[Any] = []    # keep the files that scenes of logs refer to


def load(scene: str | Path | dict, **overrides: Any) -> Simulation:
    """
    Return the simulation of a scene, at its start, or of a log, at its first frame.

    A log that a node's ``~/record`` began in the middle of a run holds the state of that moment.

    Parameters
    ----------
    scene : path of a scene file, name of a shipped scene, or the scene as a mapping; or path of a
        log, its folder or .mcap file, which needs ROS
    overrides : values of single keys, as in ``load('towel', **{'solver.substeps': 32})``; none
        for a log

    Raises
    ------
    InputError : the scene or log is not valid; the message names file, key, value, unit and remedy
    TypeError : not a path, name or mapping

    """
    overrides = plain(overrides)
    if isinstance(scene, dict):
        return compile_scene(scene_from_mapping(plain(scene), where='scene', name='scene',
                                                overrides=overrides))
    if not isinstance(scene, (str, Path)):
        raise TypeError(f'{scene!r} is not a path of a scene file, a name or a mapping')
    if scene == '':
        raise InputError("scene: has no name; give that of a scene file or log, or '.' for a log "
                         'in the working directory')
    path = Path(scene)
    if _is_log(path):
        return _of_log(path, overrides)
    return compile_scene(load_scene(str(scene), overrides))


def _is_log(path: Path) -> bool:
    try:
        return path.is_dir() and any(path.glob('*.mcap')) or path.suffix == '.mcap'
    except OSError as error:
        raise InputError(f'{brief(str(path))}: {error.strerror}') from None


def _of_log(path: Path, overrides: dict[str, Any]) -> Simulation:
    """Return the simulation of a log, at its first frame."""
    if overrides:
        raise InputError(f'{path}: the state of a log goes with the keys of its scene; change '
                         'live ones by SetKey')
    try:
        from xpbd_ros.ros.logged_commands import Recording
    except ImportError as error:
        raise InputError(f'{path}: reading a log needs ROS 2 ({error})') from None
    recording = Recording(str(path))
    simulation = compile_scene(recording.scene)
    recording.begin(simulation)
    _recordings.append(recording)
    return simulation


def rollouts(start: Simulation | State, sequences: Iterable[Sequence[Sequence[Command]]],
             measure: Callable[[Iterator[Frame]], Result], *,
             workers: int | None = None) -> list[Result]:
    """
    Simulate several sequences of commands from the same state, in parallel threads.

    Parameters
    ----------
    start : initial state of all rollouts; not changed
    sequences : of each rollout, the commands by frame; its length is the number of frames
    measure : is given the frames of one rollout, each computed when the iterator is advanced, and
        returns the result. It may stop early
    workers : number of threads; None: one per CPU

    Returns
    -------
    results in the order of the sequences, the same for any number of workers

    Raises
    ------
    InputError : ``workers`` is less than 1
    TypeError : ``start`` is neither a simulation nor a saved state

    """
    state = start.save() if isinstance(start, Simulation) else start
    if not isinstance(state, State):
        raise TypeError(f'{start!r} is not a simulation or a state from Simulation.save()')
    if workers is not None and workers < 1:
        raise InputError(f'workers: must be >= 1 (got {workers})')

    def roll_out(sequence: Sequence[Sequence[Command]]) -> Result:
        simulation = state.simulation()
        return measure(simulation.step(commands) for commands in sequence)

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        return list(pool.map(roll_out, sequences))
