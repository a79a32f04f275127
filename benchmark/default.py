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
import sys

import yaml

from xpbd_ros.cli.run import count_frames
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.study.accuracy import measure
from xpbd_ros.study.accuracy.choose import recommend
from xpbd_ros.study.accuracy.solver_setting import AUTO, setting_of, with_solver

LINES = (4, 8, 16, 32, 64)
"""substeps of ``line`` in the ladder"""
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


def compare(name: str, scene, budgets, folder: Path) -> None:
    """Print the default beside the best setting as fast, for each budget."""
    auto, line, found = study(scene, budgets, folder)
    rows = {row.setting.key: row for row in found.rows}
    print(f'{name}: {found.what}, known to {1e3 * found.floor:.2g} mm')
    for budget in budgets:
        row, alone = rows[auto[budget].key], rows[line[budget].key]
        best = recommend(found.rows, found.by, budget=row.timed.ms_p95, floor=found.floor)
        if best is None:
            print(f'  {budget:g} ms: {row.setting.key}: {row.errors.note or "no error"}')
            continue
        print(f'  {budget:g} ms: {told(row, found)}; best as fast {told(best, found)}; line alone '
              f'{told(alone, found)}', flush=True)


def told(row, found) -> str:
    """Return a setting, its error and its time."""
    return (f'{row.setting.key}: {1e3 * row.error(found.by):.3g} mm, {row.timed.ms_p50:.2f} ms, '
            f'95 % {row.timed.ms_p95:.2f} ms')


def main(words=None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0].strip())
    parser.add_argument('scenes', nargs='*')
    parser.add_argument('-o', '--output', default='default_study', type=Path)
    parser.add_argument('--budgets', default='2,4,8')
    arguments = parser.parse_args(words)
    budgets, own = [float(text) for text in arguments.budgets.split(',')], sheets()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.scenes or own:
        scene = (scene_from_mapping(own[name], where=str(FILE), name=name) if name in own else
                 load_scene(name))
        compare(name, scene, budgets, arguments.output / Path(name).stem)
    return 0


if __name__ == '__main__':
    sys.exit(main())
