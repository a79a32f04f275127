"""
Compare the frame times that ``auto`` predicts with those measured: the table of doc/solver.md.

    python benchmark/prediction.py [SCENE …] [--random 40] [--seed 1] [--table FILE] [--json FILE]

SCENE is a shipped scene or a file; all shipped scenes and the random ones unless given. Each runs
with ``line`` as ``auto`` would choose it, and with ``explicit`` where ``auto`` may mix it and its
stable substeps fit the budget. Measured is the thread CPU time of a frame, the mean over the
scene's duration; predicted is that by the shipped cost table, and by that of a file beside it.
"""

import argparse
import json
from pathlib import Path
import sys
import tempfile

import numpy as np

from random_scenes import ALL_KINDS
from xpbd_ros.scene.cost_table import read_table, SHIPPED
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.share import shipped_scenes
from xpbd_ros.study.cost.calibrate import BY_MOTION, measure, METHODS, Run
from xpbd_ros.study.cost.random_scenes import random_scenes
from xpbd_ros.study.machine import describe, machine


def line(run: Run, ratios: list[float]) -> str:
    """Return a row of the table."""
    return (f'{run.scene:14} {run.method:9} {run.substeps:4} substeps {run.particles:6} particles '
            f'{1e-6 * run.measured_ns:7.2f} ms measured; predicted / measured '
            + ' '.join(f'{ratio:5.2f}' for ratio in ratios))


def summary(runs: list[Run], ratios: np.ndarray) -> str:
    """Return the median and the largest deviation of the ratio from 1."""
    off = np.abs(ratios - 1.0)
    return (f'{len(runs)} runs: {np.median(off):.0%} off in the median, {off.max():.0%} at worst '
            f'({runs[int(off.argmax())].scene}), {(off <= 0.4).mean():.0%} of them within 40 %')


def main(words=None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0].strip())
    parser.add_argument('scenes', nargs='*')
    parser.add_argument('--random', type=int, metavar='N', help='number of random scenes')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--table', type=Path, metavar='FILE')
    parser.add_argument('--json', type=Path, metavar='FILE')
    arguments = parser.parse_args(words)
    count, names = arguments.random, arguments.scenes
    if not names and not count:
        names, count = list(shipped_scenes()), 40
    tables = [SHIPPED] + ([read_table(str(arguments.table))] if arguments.table else [])
    print(describe(machine()))
    runs, ratios = [], []
    with tempfile.TemporaryDirectory() as folder:
        drawn = random_scenes(count or 0, arguments.seed, Path(folder), ALL_KINDS)
        for scene in (*map(load_scene, names), *(
                scene_from_mapping(raw, where=f'{name}.yaml', name=name)
                for name, raw in drawn.items())):
            for method in METHODS if not set(BY_MOTION) & set(scene.effect_names) else ('line',):
                run = measure(scene, method, round(scene.top.duration * scene.top.frame_rate))
                if run is not None:
                    runs.append(run)
                    ratios.append([run.predicted_ns(table) / run.measured_ns for table in tables])
                    print(line(run, ratios[-1]), flush=True)
    hard = np.array([any(('effects', name) in run.counts for name in BY_MOTION) for run in runs])
    for label, found in zip(('shipped table', 'table of the file'), np.transpose(ratios)):
        print(f'{label}: {summary(runs, found)}')
        if hard.any() and not hard.all():
            print(f'  without {" and ".join(BY_MOTION)}: '
                  f'{summary([run for run, h in zip(runs, hard) if not h], found[~hard])}')
    if arguments.json:
        arguments.json.write_text(json.dumps([{
            'scene': run.scene, 'method': run.method, 'substeps': run.substeps,
            'particles': run.particles, 'measured_ms': 1e-6 * run.measured_ns, 'ratios': found}
            for run, found in zip(runs, ratios)], indent=1))
    return 0


if __name__ == '__main__':
    sys.exit(main())
