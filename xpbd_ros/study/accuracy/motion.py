"""Settings of a finished study that show the cost of accuracy, to be run side by side."""

from dataclasses import fields
import json
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from xpbd_ros.errors import InputError
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.study.accuracy.report import name_of
from xpbd_ros.study.accuracy.solver_setting import Setting, with_solver
from xpbd_ros.study.accuracy.truth import own_rungs

NUMBERS, SCENE = 'accuracy.json', 'scene.yaml'
"""files in the folder of a study"""


class Shown(NamedTuple):
    """A setting to show."""

    name: str
    """with its time and error"""
    scene: Scene


class Report(NamedTuple):
    """Settings of a finished study, to be run side by side."""

    settings: list[Shown]
    """the reference first"""
    frames: int
    commands: str | None
    """log with the inputs of the study; None for none"""


def report_of(path: Path) -> Report | None:
    """
    Return the settings that a finished study shows: reference, recommended, cheapest.

    The reference is the finest setting of the simulation's own limit for dt → 0. Without a
    recommendation the most accurate setting is shown.

    Parameters
    ----------
    path : folder of the study, or a file in it; None is returned for any other path

    Raises
    ------
    InputError : the study is not complete

    """
    folder = path if path.is_dir() else path.parent
    file = folder / NUMBERS
    if not file.is_file() or path.is_file() and path.suffix not in ('.json', '.html'):
        return None
    try:
        numbers = json.loads(file.read_text(encoding='utf-8'))
        rows = [row for row in numbers['settings'] if row['ms_p50'] is not None
                and row['error_m'] is not None and not row['baseline']]
        recommended, frames = numbers['recommended'], int(numbers['frames'])
        commands = numbers['commands']
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f'{file}: is no complete report of xpbd_ros accuracy '
                         f'({type(error).__name__}: {error}); run the study again') from None
    if not rows:
        raise InputError(f'{file}: no setting has both an error and a time')
    scene = load_scene(str(folder / SCENE))
    best = recommended or min(rows, key=lambda row: row['error_m'])
    cheapest = min(rows, key=lambda row: row['ms_p50'] or inf)
    finest = own_rungs(scene)[-1]
    found = [Shown(f'reference\n{name_of(finest)}', with_solver(scene, finest.block()))]
    for word, row in (('recommended' if recommended else 'most accurate', best),
                      ('cheapest', cheapest)):
        setting = _setting(row)
        if word != 'cheapest' or setting != _setting(best):
            found.append(Shown(f'{word}\n{name_of(setting)}\n{row["ms_p50"]:.3g} ms, '
                               f'{row["error_m"]:.2g} m', with_solver(scene, setting.block())))
    return Report(found, frames, commands)


def _setting(row: dict) -> Setting:
    """Return the setting of a row; only a mix has the keys of rough frames."""
    keys: Any = {key.name: row.get(key.name) for key in fields(Setting)}
    return Setting(**keys)
