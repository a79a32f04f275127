"""Strain limits and tethers: how far is too far, what they pull with, and when they do nothing."""

import numpy as np
import pytest
from sim.small import DOWN, GRAVITY, run, simulate

from xpbd_ros.sim.commands import Grasp, Pose, Release

SOFT = {'stretch': {'warp': 2.0, 'weft': 2.0}}
"""of 10 N/m² of cloth, 1 m long: a strain of several times its length"""
UP = [0.0, -DOWN[1], 0.0, DOWN[3]]
TOP = {'top': {'cloth': 'c', 'at': 'edge_x0'}}


def hang(effects, *, pins=TOP, grid=(7, 3), **options):
    """Return a sheet of 1 m that hangs from its top edge."""
    return simulate(grid, (1.0, 0.4), effects={**SOFT, **effects}, pins=pins,
                    scene_effects={'pin': {}, 'damping': {'rate': 5}},
                    **{'substeps': 20, 'pose': {'orientation': DOWN}, **options})


def strains(frame, shape=(3, 7)):
    """Return the strain of each edge along warp."""
    x = frame.x.reshape(*shape, 3)
    return np.linalg.norm(np.diff(x, axis=1), axis=2) * 6.0 - 1.0


@pytest.mark.parametrize('method', ['line', 'jacobi', 'explicit'])
def test_no_edge_is_longer_than_its_limit(method):
    more = {'method': method, 'integrator': 'leapfrog' if method == 'explicit' else 'bdf2'}
    for turned in ({}, {'pose': {'orientation': UP}, 'pins': {
            'top': {'cloth': 'c', 'at': 'edge_x1'}}}):
        frame = run(hang({'strain_limit': {'max': 0.2}}, **more, **turned), 60)
        assert 0.15 < strains(frame).max() < 0.22
        assert frame.pins['top'].force[2] == pytest.approx(-0.4 * GRAVITY, rel=0.05)


def test_without_a_limit_it_would_be():
    assert strains(run(hang({}), 60)).max() > 0.5


@pytest.mark.parametrize('effect', [{'strain_limit': {'max': 20.0}}, {'tether': {'slack': 20.0}}])
def test_what_is_not_too_far_is_not_touched(effect):
    assert len({simulation.hash() for simulation in (hang(effect), hang({}))
                if run(simulation, 20)}) == 1


def test_a_limit_keeps_momentum():
    simulation = simulate((7, 3), (1.0, 0.4), gravity=(0, 0, 0), substeps=5, effects={
        **SOFT, 'strain_limit': {'max': 0.0}})
    state, slot = simulation.state, simulation.slot
    state.v[:, slot] = np.random.default_rng(1).normal(0.0, 1.0, (3, len(slot)))
    x, m = simulation.frame().x, state.mass[slot]
    before = m @ simulation.frame().v, m @ np.cross(x, simulation.frame().v)
    frame = run(simulation, 20)
    np.testing.assert_allclose(m @ frame.v, before[0], atol=1e-13)
    assert strains(frame).max() < 0.1
    across = np.linalg.norm(np.diff(frame.x.reshape(3, 7, 3), axis=0), axis=2)
    assert across.max() < 1.1 * 0.2


@pytest.mark.parametrize('method', ['line', 'jacobi', 'explicit'])
def test_no_particle_is_further_from_a_pin_than_the_cloth_reaches(method):
    """With one substep, where the edges alone would be many times as long."""
    more = {'method': method, 'integrator': 'leapfrog' if method == 'explicit' else 'bdf2',
            'substeps': 20 if method == 'explicit' else 1}
    simulation = hang({'tether': {'slack': 0.1}}, **more)
    frame = run(simulation, 60)
    fall = -frame.x.reshape(3, 7, 3)[..., 2]
    reach = np.arange(7) / 6.0 * 1.1
    assert (fall <= reach * (1.0 + 1e-9)).all()
    assert fall.max() == pytest.approx(1.1, rel=1e-3)
    assert frame.pins['top'].force[2] == pytest.approx(-0.4 * GRAVITY, rel=0.05)
    assert simulation.stats()['tethers_taut'] >= 3
    aslant = (2.0, -5.0, -8.0)
    frame = run(hang({'tether': {'slack': 0.1}}, gravity=aslant, **more), 180)
    np.testing.assert_allclose(frame.pins['top'].force, 0.4 * np.array(aslant), atol=0.2)


def test_tethers_follow_grasps_and_releases():
    """Two corners are two groups; an edge is one, and holds each particle by the nearest."""
    simulation = hang({'tether': {'slack': 0.0}}, pins={
        'a': {'cloth': 'c', 'at': 'corner_00'}, 'b': {'cloth': 'c', 'at': 'corner_10'}})
    data = simulation.effects['tether'].data
    assert data.count[0] == 2 * 19
    slots = simulation.cloths[0].slots
    far = data.longest[:38][data.particle[:38] == slots[6]]
    assert sorted(far) == pytest.approx([1.0, 1.0 + 0.4 - 2 * 0.2 + 2 * (
        np.hypot(1 / 6, 0.2) - 1 / 6)])
    simulation.step([Release('b')])
    assert data.count[0] == 20
    simulation.step([Release('a')])
    assert data.count[0] == 0
    before = simulation.frame().x[20]
    simulation.step([Grasp('c', Pose(tuple(before)), 0.05)])
    assert data.count[0] == 20
    assert set(data.pinned[:20]) == {slots[20]}
    assert (data.particle[:20] != slots[20]).all()


def test_an_edge_that_is_held_holds_each_particle_by_the_nearest():
    simulation = hang({'tether': {'slack': 0.0}})
    data = simulation.effects['tether'].data
    assert data.count[0] == 18
    columns = np.argsort(simulation.cloths[0].slots)
    number = columns[np.searchsorted(simulation.cloths[0].slots[columns], data.particle[:18])]
    np.testing.assert_allclose(data.longest[:18], number % 7 / 6.0, rtol=1e-12)


def test_cloth_without_pins_has_no_tethers():
    simulation = simulate((7, 3), (1.0, 0.4), effects={**SOFT, 'tether': {}})
    run(simulation, 2)
    assert simulation.stats()['tethers'] == 0
