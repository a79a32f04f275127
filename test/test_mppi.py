"""The example of doc/many.md: rollouts by which two grippers learn to fold a towel."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[1] / 'doc' / 'examples' / 'mppi_fold.py'


@pytest.fixture(scope='module')
def example():
    """Return the example as a module."""
    spec = importlib.util.spec_from_file_location('mppi_fold', EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_motion_begins_at_the_corners_and_stays_above_the_table(example):
    steps = np.tile([-0.02, -0.1], (example.KNOTS, 1))
    path = example.path(steps)
    assert path[0] == pytest.approx([example.SIZE, example.THICKNESS], abs=0.05)
    assert path[-1] == pytest.approx([example.SIZE - 0.02 * example.KNOTS, example.THICKNESS])
    assert len(example.commands(steps)) == example.MOVING + example.RESTING
    assert example.cost(example.goal()) == 0.0


@pytest.mark.slow
def test_planning_improves_the_fold(example, tmp_path):
    """From a towel that is dropped to one that is folded; its figure is drawn."""
    costs, motions = example.plan(rounds=5)
    assert costs[0] > 0.1
    assert min(costs) < 0.1 * costs[0]
    assert costs[-1] < 0.5 * costs[0]
    example.draw(costs, motions, tmp_path / 'fold.png')
    assert (tmp_path / 'fold.png').stat().st_size > 10_000
