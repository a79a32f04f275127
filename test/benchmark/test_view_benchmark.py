"""The benchmark of the page runs with a browser, and tells the figures that it promises."""

import json
import os
from pathlib import Path
import subprocess
import sys

import pytest

from support.browser import CHROMIUM, MISSING

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=MISSING)]
CHECKOUT = Path(__file__).parents[2]


def test_it_measures_a_page_with_a_browser(tmp_path):
    pytest.importorskip('viser', reason="viser is missing: pip install '.[view]'")
    file = tmp_path / 'figures.json'
    done = subprocess.run(
        [sys.executable, 'benchmark/view.py', '--seconds', '4', '--colour', 'contact force',
         '--json', str(file)], cwd=CHECKOUT, env={**os.environ, 'PYTHONPATH': str(CHECKOUT)},
        capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(file.read_text())
    assert found['same_bits']
    assert found['particles'] == 41 * 57
    assert found['pictures_per_s'] > 1.0
    assert 0.0 < found['share'] < 1.0
    assert found['drawn_without_browser'] == 0
    assert found['drawing_ms'] > found['drawing_ms_without_browser'] == 0.0
