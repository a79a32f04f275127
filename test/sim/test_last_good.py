"""A frame that cannot be is taken back, counted, and the cloth goes on from where it was."""

import numpy as np
import pytest

from support.scenes import FEW, GRAVITY, run, with_effects
from xpbd_ros.sim.measure import elastic_energy, kinetic_energy, potential_energy
from xpbd_ros.sim.particles.state import history_arrays
from xpbd_ros.sim.stepping.rollback import REACH


@pytest.fixture(scope='module', params=[
    'ndf2', pytest.param('bdf2', marks=pytest.mark.slow)])
def cloth(request):
    """Return a cloth, pinned at a corner, that has swung for a while."""
    simulation = with_effects(
        method='line', integrator=request.param,
        names=FEW if request.param == 'ndf2' else ('stretch', 'shear', 'contact'),
        colliders={'table': {'plane': {}, 'position': [0, 0, -9]}})
    run(simulation, 20)
    return simulation


def total_energy(cloth):
    return kinetic_energy(cloth.state) + potential_energy(cloth.state) + elastic_energy(cloth)


@pytest.mark.parametrize(('array', 'value'), [
    ('x', np.nan), ('x', np.inf), ('x', -np.inf), ('x', 1e300), ('v', np.nan), ('v', -np.inf)])
def test_a_frame_that_cannot_be_is_taken_back(cloth, monkeypatch, array, value):
    before, taken_back = cloth.frame(), cloth.stats()['frames_taken_back']
    whole, pin = cloth._advance, cloth.effects['pin'].data

    def advance():
        whole()
        for broken in (getattr(cloth.state, array), *history_arrays(cloth.state)):
            broken[1, cloth.slot[7]] = value
        pin.last[:] = pin.older[:] = value

    monkeypatch.setattr(cloth, '_advance', advance)
    frame = cloth.step()
    np.testing.assert_array_equal(frame.x, before.x)
    assert (frame.v == 0.0).all()
    assert frame.index == before.index + 1
    assert cloth.stats()['frames_taken_back'] == taken_back + 1
    monkeypatch.undo()
    energy = total_energy(cloth)
    cloth.step()
    assert kinetic_energy(cloth.state) > 0.0
    assert total_energy(cloth) < energy, 'it falls from rest'
    later = run(cloth, 4)
    assert np.isfinite(later.x).all()
    assert np.abs(later.x - before.x).max() > 0.0
    assert np.abs(later.pins['a'].force).max() < 100.0 * cloth.state.mass.sum() * GRAVITY
    assert cloth.stats()['frames_taken_back'] == taken_back + 1


def test_the_fastest_that_can_be_is_let_through():
    """A frame in which gravity of 1e7 m/s² moves the cloth by kilometres is plausible too."""
    options = {'pins': {}, 'colliders': {'table': {'plane': {}, 'position': [0, 0, -1e9]}}}
    heavy = with_effects(gravity=(0.0, 0.0, -1e7), **options)
    run(heavy, 3)
    assert heavy.stats()['frames_taken_back'] == 0
    cloth = with_effects(**options)
    cloth.state.v[0, cloth.slot] = 0.5 * REACH * 60.0
    run(cloth, 2)
    assert cloth.stats()['frames_taken_back'] == 0
    cloth.state.v[0, cloth.slot] = 4.0 * REACH * 60.0
    run(cloth, 1)
    assert cloth.stats()['frames_taken_back'] == 1
