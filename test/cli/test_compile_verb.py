"""``compile``: kernels ahead of time, where the environment says."""

import json
import os
import subprocess
import sys

from xpbd_ros.cli.main import main

SCENE = """
cloths:
  strip: {grid: {size: [0.1, 0.1], resolution: [2, 2]}, density: 0.2,
          effects: {stretch: {warp: 10.0, weft: 10.0}}}
solver: {method: gauss_seidel, integrator: backward_euler}
"""
RUN = ('import sys; from xpbd_ros.scene.compile import compile_scene; '
       'from xpbd_ros.scene.load import load_scene; from xpbd_ros.sim.stepping import step; '
       'compile_scene(load_scene(sys.argv[1])).step(); '
       '(made,) = step._COMPILED.values(); '
       'print(sum(made.stats.cache_misses.values()), sum(made.stats.cache_hits.values()))')


def test_another_process_compiles_nothing_more(tmp_path):
    file = tmp_path / 'strip.yaml'
    file.write_text(SCENE)
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path / 'kernels')}

    def python(*arguments):
        return subprocess.run([sys.executable, *arguments], env=environment, text=True,
                              capture_output=True, check=True).stdout
    report = tmp_path / 'report.json'
    said = python('-m', 'xpbd_ros', 'compile', str(file), '--json', str(report)).splitlines()
    numbers = json.loads(report.read_text())
    assert numbers['cache'].startswith(f'{tmp_path}/kernels/xpbd_ros/')
    assert list(numbers['scenes']) == [str(file)]
    assert numbers['scenes'][str(file)] > 0.0
    assert said[0].startswith(f'{file}: ')
    assert said[-1].startswith(f'kernels are in {tmp_path / "kernels" / "xpbd_ros"}')
    kept = set((tmp_path / 'kernels').rglob('*.nbc'))
    assert kept
    assert python('-c', RUN, str(file)).split() == ['0', '1']
    assert set((tmp_path / 'kernels').rglob('*.nbc')) == kept


def test_a_refused_scene_stops_it_before_compiling(capsys):
    assert main(['compile', 'towel', 'towle']) == 2
    out, error = capsys.readouterr()
    assert out == ''
    assert "did you mean 'towel'" in error
