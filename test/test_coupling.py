"""The example of doc/coupling.md: a MuJoCo body and a cloth that move one another."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from xpbd_ros.sim import measure

EXAMPLE = Path(__file__).parents[1] / 'doc' / 'examples' / 'mujoco_body.py'


@pytest.fixture(scope='module')
def example():
    """Return the example as a module."""
    pytest.importorskip('mujoco', reason="mujoco is missing: pip install '.[mujoco]'")
    spec = importlib.util.spec_from_file_location('mujoco_body', EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_body_and_cloth_keep_momentum_and_gain_no_energy(example):
    """
    Within 2 % of the momentum, and 1 % of the energy, with which the body falls into the sheet.

    The body counts with the impulse that it gets in the next frame.
    """
    both, mass = example.Coupled(), example.MASS
    cloth, state, dt = both.cloth, both.cloth.state, both.cloth.frame_dt
    weight = np.array([0.0, 0.0, -example.G]) * (mass + state.mass.sum())
    given, errors, energies, heights, fastest = np.zeros(3), [], [], [], 0.0
    for _ in range(round(2.0 * example.RATE)):
        frame = both.step()
        spin, heights = both.data.qvel[3:], [*heights, both.body.xpos[2]]
        velocity = both.data.qvel[:3] + dt / mass * frame.colliders['body'].force
        given += dt * (weight - sum(pin.force for pin in frame.pins.values()))
        errors.append(mass * velocity + measure.momentum(state) - given)
        energies.append(
            mass * (0.5 * velocity @ velocity + example.G * heights[-1])
            + 0.5 * spin @ (both.model.body('body').inertia * spin)
            + measure.kinetic_energy(state) + measure.potential_energy(state)
            + measure.elastic_energy(cloth))
        fastest = max(fastest, -velocity[2])
    fall = 0.5 * mass * fastest**2
    assert fastest > 2.0
    assert min(heights) < -0.1, 'the sheet gives way'
    assert -0.4 < heights[-1] < 0.2, 'and carries it'
    assert np.linalg.norm(errors, axis=1).max() < 0.02 * mass * fastest
    assert (energies - np.minimum.accumulate(energies)).max() < 0.01 * fall
    assert energies[-1] < energies[0] - 0.1 * fall
