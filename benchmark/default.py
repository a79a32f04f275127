"""
Compare the default setting with a ladder of others, as in doc/accuracy.md.

    python benchmark/default.py [SCENE …] [-o DIR] [--budgets 2,4,8]

SCENE is a shipped scene, a file, or one of the sheets below; all sheets unless given. For each
budget it prints what ``auto`` chooses, its error, its time, and the most accurate setting whose
95th percentile is not larger: of ``line`` with several numbers of substeps, ``explicit`` as fine
as it must be and twice as fine, and what ``auto`` would choose of ``line`` alone.
"""

import argparse
from pathlib import Path
from statistics import median
import sys

import yaml

from xpbd_ros.cli.run import count_frames
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.study.accuracy import measure
from xpbd_ros.study.accuracy.choose import Default, judge_defaults, SHAPE
from xpbd_ros.study.accuracy.solver_setting import AUTO, setting_of, with_solver
from xpbd_ros.study.machine import describe, machine

SHIPPED = ('arch', 'bag', 'balloon', 'curtain', 'drape', 'flag', 'fold', 'fold_towel', 'grip',
           'sheet', 'softbox', 'swing', 'towel')
LINES = (4, 8, 16, 32, 64)
"""substeps of ``line`` in the ladder"""
COLUMNS = ('Scene', 'Budget', '`auto`', 'Median, 95 %', 'Error', 'Best as fast', 'Ratio',
           '`line` alone: 95 %, error')
"""budgets and times [ms], errors [mm]"""
FILE = Path(__file__).with_name('default_scenes.yaml')


def sheets() -> dict[str, dict]:
    """Return the scenes of the file beside this one, by name."""
    return yaml.safe_load(FILE.read_text(encoding='utf-8'))


def chosen(scene, budget: float, method: str = 'auto'):
    """Return the setting that ``auto`` chooses, or its part of ``line``."""
    return setting_of(compile_scene(with_solver(
        scene, {**AUTO, 'method': method, 'budget_ms': budget})))


def study(scene, budgets, folder: Path):
    """Return the settings of ``auto`` and ``line`` by budget, and the study of all settings."""
    auto = {budget: chosen(scene, budget) for budget in budgets}
    line = {budget: chosen(scene, budget, 'line') for budget in budgets}
    whole = measure.ladder

    def ladder(scene, methods, **options):
        found, refused = whole(scene, methods, **options)
        kept = [one for one in found if one.iterations == 1 and one.precision == 'float64' and (
            one.method == 'explicit' or one.integrator == 'ndf2' and one.substeps in LINES)]
        fewest = min((one.substeps for one in kept if one.method == 'explicit'), default=0)
        kept = [one for one in kept if one.method == 'line' or one.substeps <= 2 * fewest]
        return list({one.key: one for one in (*kept, *auto.values(), *line.values())}.values()
                    ), refused

    measure.ladder = ladder
    try:
        return auto, line, measure.study(scene, count_frames(scene), folder,
                                         methods=('line', 'explicit'))
    finally:
        measure.ladder = whole


def compare(name: str, scene, budgets, folder: Path) -> list[Default]:
    """Print a row for each choice of ``auto``, and return them, one for each budget."""
    auto, line, found = study(scene, budgets, folder)
    rows = {row.setting.key: row for row in found.rows}
    judged = judge_defaults(found.rows, found.by, auto, found.floor)
    if len(judged) < len(budgets):
        print(f'| `{name}` | | not judged: no error or no time | | | | | |')
    for key in dict.fromkeys(each.row.setting.key for each in judged):
        same = [each for each in judged if each.row.setting.key == key]
        row, best, alone = same[0].row, same[0].best, rows[line[same[0].budget_ms].key]
        cells = (f"`{name}`{' (heights)' if found.by == SHAPE else ''}",
                 ', '.join(f'{each.budget_ms:g}' for each in same), told(row, auto=True),
                 f'{row.timed.ms_p50:.2f}, {row.timed.ms_p95:.2f}', error(row, found),
                 'the same' if best is row else f'{told(best)}: {error(best, found)}',
                 f'{same[0].ratio:.2g}', 'the same' if alone is row else
                 f'{told(alone)}: {alone.timed.ms_p95:.2f} ms, {error(alone, found)}')
        print(f"| {' | '.join(cells)} |", flush=True)
    return judged


def told(row, *, auto: bool = False) -> str:
    """Return a setting; of ``auto``, without what it takes for rough frames."""
    setting = row.setting
    if setting.method != 'explicit':
        return f'`{setting.method}`, `{setting.integrator}`, {setting.substeps}'
    return f'`explicit` {setting.substeps}' + ('' if auto or setting.rough_frames else ' alone')


def error(row, found) -> str:
    """Return the error of a setting [mm], with that of the truth if it is larger."""
    text = f'{1e3 * row.error(found.by):.2g}'
    return f'{text} (± {1e3 * found.floor:.2g})' if row.error(found.by) < found.floor else text


def main(words=None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0].strip())
    parser.add_argument('scenes', nargs='*')
    parser.add_argument('-o', '--output', default='default_study', type=Path)
    parser.add_argument('--budgets', default='2,4,8')
    arguments = parser.parse_args(words)
    budgets, own = [float(text) for text in arguments.budgets.split(',')], sheets()
    arguments.output.mkdir(parents=True, exist_ok=True)
    print(f"{describe(machine())}\n\n| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|",
          flush=True)
    judged = []
    for name in arguments.scenes or (*SHIPPED, *own):
        scene = (scene_from_mapping(own[name], where=str(FILE), name=name) if name in own else
                 load_scene(name))
        judged += compare(name, scene, budgets, arguments.output / Path(name).stem)
    ratios = [each.ratio for each in judged]
    print(f'\n{len(ratios)} cases: {sum(ratio <= 1.5 for ratio in ratios)} within 1.5 times the '
          f'best, median {median(ratios):.3g}, largest {max(ratios):.3g}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
