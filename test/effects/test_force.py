"""A constant force: what it gives to free particles, and what it hands to pins."""

import numpy as np
import pytest

from support.scenes import run, simulate
from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import SetKey

F = (1.5, -2.0, 0.5)


def pushed(force, **options):
    """Return a flat sheet of 2 kg without elasticity or gravity, under a force."""
    return simulate((4, 3), (1.0, 1.0), density=2.0, gravity=(0.0, 0.0, 0.0),
                    scene_effects={'force': force}, **options)


@pytest.mark.parametrize('integrator', ['backward_euler', slow('bdf2')])
def test_what_is_free_speeds_up_by_force_over_mass(integrator):
    """V1 with a force: v = f t / m, exactly."""
    for force, expected in (({'per_mass': F}, lambda mass: np.outer(np.ones(12), F)),
                            ({'per_particle': F}, lambda mass: np.outer(1.0 / mass, F)),
                            ({'total': F}, lambda mass: np.outer(np.full(12, 0.5), F))):
        simulation = pushed(force, integrator=integrator, substeps=3)
        mass = simulation.state.mass[simulation.slot]
        frame = run(simulation, 30)
        np.testing.assert_allclose(frame.v, 0.5 * expected(mass), rtol=1e-9)
        way = 0.25 * expected(mass) * 0.5
        np.testing.assert_allclose(frame.x - pushed(force).frame().x, way, rtol=0.02)


def test_a_force_per_mass_is_gravity():
    simulation = pushed({'per_mass': [0.0, 0.0, -9.80665]}, substeps=2)
    falling = simulate((4, 3), (1.0, 1.0), density=2.0, substeps=2)
    np.testing.assert_allclose(run(simulation, 20).x, run(falling, 20).x, atol=1e-13)


def test_only_what_is_named_is_pushed():
    frame = pushed({'total': F, 'cloth': 'c', 'at': 'corner_11'}).step()
    assert (frame.v.any(1) == (np.arange(12) == 11)).all()
    frame = pushed({'per_particle': F, 'cloth': 'c', 'at': [1, 5]}).step()
    assert (np.flatnonzero(frame.v.any(1)) == [1, 5]).all()


@pytest.mark.parametrize('precision', ['float64', slow('float32')])
def test_what_is_pinned_hands_the_force_to_its_pin(precision):
    simulation = pushed({'total': F}, pins={'a': {'cloth': 'c', 'at': list(range(12))}},
                        precision=precision, substeps=3)
    frame = run(simulation, 2)
    np.testing.assert_allclose(frame.pins['a'].force, F, rtol=1e-6)
    assert not frame.v.any()


def test_it_can_change_while_running():
    simulation = pushed({'per_mass': F})
    simulation.step()
    frame = simulation.step([SetKey('effects.force.per_mass', [-c for c in F])])
    np.testing.assert_allclose(frame.v, 0.0, atol=1e-15)


@pytest.mark.parametrize(('force', 'reason'), [
    ({}, 'effects.force: needs per_particle (N), per_mass (N/kg) or total (N), and only one'),
    ({'total': F, 'per_mass': F}, 'and only one of them'),
    ({'total': F, 'at': 'corner_00'}, 'at: needs cloth'),
    ({'total': F, 'cloth': 'd'}, "effects.force.cloth: unknown cloth 'd' (known: c)"),
    ({'total': F, 'cloth': 'c', 'at': 'top'}, "at: unknown place 'top' (known: corner_00"),
    ({'total': F, 'cloth': 'c', 'at': [12]}, 'effects.force.at: indices must be from 0 to 11'),
    ({'total': [0.0, 0.0]}, 'effects.force.total: must be 3 numbers in N (got 2)'),
])
def test_a_force_that_makes_no_sense_is_refused(force, reason):
    with pytest.raises(InputError) as error:
        pushed({key: list(value) if isinstance(value, tuple) else value
                for key, value in force.items()})
    assert reason in str(error.value)
