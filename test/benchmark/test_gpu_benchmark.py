"""The benchmark of a card: without one, and on one that is emulated."""

import importlib.util
import json
from pathlib import Path

import pytest

from support.ptx_emulator import EmulatedCard
from xpbd_ros.sim.backend import cuda

FILE = Path(__file__).parents[2] / 'benchmark' / 'gpu.py'


@pytest.fixture
def gpu():
    spec = importlib.util.spec_from_file_location('gpu_benchmark', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_a_card_it_says_so(gpu, monkeypatch, capsys):
    monkeypatch.setattr(cuda, 'LIBRARY', 'libcuda_of_no_machine.so')
    assert gpu.main(['--what', 'bits']) == 2
    said = capsys.readouterr()
    assert said.out == ''
    line, = said.err.splitlines()
    assert line.startswith('gpu.py: solver.device: cuda needs an NVIDIA card')


def test_the_model_counts_bytes_and_barriers(gpu, capsys):
    """Of 3 × 3 particles: 12 edges, 8 diagonals, 6 curvatures and 4 twists."""
    assert gpu.main(['--what', 'model', '--sizes', '3', '--json', '-']) == 0
    row = json.loads(capsys.readouterr().out)['model'][0]
    assert row['bytes_per_particle'] * 9 == pytest.approx(4 * (
        12 * (14 + 2) + 8 * (14 + 2) + 6 * (21 + 6) + 4 * (28 + 6) + 9 * 17))
    assert row['barriers'] >= 12


@pytest.mark.slow
def test_bits_and_speed_on_an_emulated_card(gpu, monkeypatch):
    class Card(EmulatedCard):
        def copy(self, target, source, size):
            assert size == gpu.COPY

        def seconds(self, work):
            work()
            return 1e-3

    monkeypatch.setattr(gpu, 'REPEATS', 2)
    monkeypatch.setattr(gpu, 'COPY', 2**10)
    monkeypatch.setattr(gpu, 'copied', lambda card: 1.0)
    monkeypatch.setattr(cuda, 'Card', Card)
    assert gpu.bits(6, None) == [
        {'particles': 36, 'contact': contact, 'repeats': 2, 'repeats_with_other_bits': 0}
        for contact in (False, True)]
    row = gpu.speed(6, Card())
    assert row['substep_us'] == pytest.approx(250.0)
    assert row['gb_per_s'] == pytest.approx(1e-9 * 4 * gpu.traffic(gpu.sheet(6))[0] / 1e-3)
