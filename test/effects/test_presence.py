"""Each effect has a law that fails where the effect does nothing."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

from xpbd_ros.effects import EFFECTS

HERE = Path(__file__).parent
LAWS = {
    'pin': 'test_pin.py::test_two_pins_share_the_weight_and_their_torques_balance_it',
    'wind': 'test_drag.py::test_the_force_on_a_pinned_sheet_is_that_of_the_formula[turn0-float64]',
    'drag': 'test_drag.py::test_a_flat_sheet_falls_as_tanh_to_its_terminal_speed'
            '[backward_euler-1.0]',
    'force': 'test_force.py::test_a_force_per_mass_is_gravity',
    'damping': 'test_damping.py::test_velocity_falls_by_the_implicit_step_in_every_substep[7]',
    'rayleigh': 'test_rayleigh.py::test_the_kelvin_voigt_oscillator_decays_as_backward_euler',
    'bend': 'test_bend.py::test_a_clamped_strip_swings_with_the_period_of_a_beam[ndf2]',
    'cross_bend': 'test_hinge.py::test_a_fold_opens_with_the_energy_that_it_stores[cross_bend]',
    'hinge': 'test_hinge.py::test_a_fold_opens_with_the_energy_that_it_stores[hinge]',
    'volume': 'test_volume.py::test_a_pulled_bar_has_youngs_modulus_and_poissons_ratio[0.3]',
    'area': 'test_area.py::test_a_squeezed_disc_of_nothing_else_gets_its_area_back',
    'pressure': 'test_pressure.py::test_the_gas_law_holds_within_the_pressure_over_the_outside',
    'shear': 'test_shear.py::test_a_sheared_sheet_pulls_with_its_modulus',
    'membrane': 'test_membrane.py::test_a_sheet_pulled_along_warp_narrows_by_poissons_ratio',
    'stretch': 'test_stretch.py::test_a_hanging_mass_stretches_m_g_alpha'
               '[0.01-1-1-gauss_seidel-backward_euler]',
    'tether': 'test_limits.py::test_no_particle_is_further_from_a_pin_than_its_tether'
              '[gauss_seidel-backward_euler]',
    'strain_limit': 'test_limits.py::test_no_edge_is_longer_than_its_limit[auto]',
    'seam': 'test_seam.py::test_a_rigid_seam_holds_what_hangs_on_it[gauss_seidel-backward_euler]',
    'self_collision': 'test_self_collision.py::test_however_fast_it_does_not_get_through[5.0]',
    'contact': 'test_contact.py::test_a_lift_carries_cloth_up_and_never_lets_it_through',
    'friction': 'test_friction.py::test_a_turntable_carries_what_lies_on_it_round',
}
"""a test of each effect"""
QUICK = ('force',)


def pytest_of(ids, *options: str, **environment: str) -> subprocess.CompletedProcess:
    """Run tests, slow ones too, in a process of its own."""
    return subprocess.run(
        [sys.executable, '-m', 'pytest', *(str(HERE / each) for each in ids), '-q', '-p',
         'no:cacheprovider', '-m', 'slow or not slow', *options],
        capture_output=True, text=True, check=False, timeout=300, cwd=HERE.parent,
        env={**os.environ, **environment,
             'PYTHONPATH': os.pathsep.join([str(HERE.parents[1]), str(HERE.parent)])})


def test_every_effect_has_a_law_here():
    assert list(LAWS) == list(EFFECTS)
    child = pytest_of(LAWS.values(), '--collect-only')
    assert child.returncode == 0, child.stdout[-2000:]
    assert f'\n{len(LAWS)} tests collected' in child.stdout


@pytest.mark.parametrize('name', [pytest.param(name, marks=[pytest.mark.slow] * (
    name not in QUICK)) for name in LAWS])
def test_a_law_fails_without_its_effect(name, tmp_path):
    """The test as it is, in a process where the effect's kernels are in no stage."""
    child = pytest_of([LAWS[name]], '-p', 'support.disable_effect', XPBD_ROS_OFF=name,
                      NUMBA_CACHE_DIR=str(tmp_path))
    assert child.returncode == 1, child.stdout[-2000:]
    assert '1 failed' in child.stdout
