"""The true solution of a scene and the errors against it, by their definitions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.study.accuracy import truth
from xpbd_ros.study.accuracy.errors import errors
from xpbd_ros.study.accuracy.trajectory import energy, Trajectory
from xpbd_ros.study.edges import Edges
from xpbd_ros.study.reference import limit, problem_of

LINE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
"""three particles in a line with two edges, the first at its rest length"""
EDGES = Edges(np.array([[0, 1], [1, 2]]), np.array([1.0, 1.6]))
EIGHT = np.zeros(9)
"""zeros for frames 0 to 8; means are taken over the last part of them (``truth.settled``)"""


def run(x, *, kinetic=EIGHT, total=EIGHT, strain=EIGHT, heights=None, **more) -> Trajectory:
    """Return a trajectory with these positions, at all frames or by frame."""
    x = x if isinstance(x, dict) else dict.fromkeys(range(9), x)
    heights = np.zeros((9, 3)) if heights is None else heights
    return Trajectory(x, kinetic, total, strain, heights, {}, **more)


def known(rungs, pushed, frames=(8,), references=None) -> truth.Truth:
    """Return the true solution extrapolated from runs."""
    return truth.make(SimpleNamespace(frame_dt=0.1), rungs, pushed, frames, references or {}, 8,
                      None)


def test_errors_are_those_of_a_run_that_is_off_by_known_amounts():
    """A run that is off by a translation of 5 mm in one frame, and by one particle in another."""
    ramp = np.arange(9.0)
    exact = known([run(LINE, kinetic=EIGHT + 0.5, total=2.0 + 0.5 * (ramp > 3.0))] * 3, run(LINE),
                  (2, 4, 8))
    moved, stretched = LINE + [3e-3, 0.0, 4e-3], LINE.copy()
    stretched[2] += [0.3, 0.4, 0.0]
    longer = np.hypot(2.3, 0.4) - 2.0
    off = run({2: moved, 4: stretched}, total=EIGHT + 1.5, strain=0.1 * ramp,
              heights=ramp[:, None] * [1.0, 2.0, 2.0])
    off.energy[4] = 2.3
    found = errors(off, exact, EDGES, 0.1)
    np.testing.assert_allclose(found.rms_m, [5e-3, 0.5 / 3.0**0.5, np.nan], rtol=1e-12)
    np.testing.assert_allclose(found.max_m, [5e-3, 0.5, np.nan], rtol=1e-12)
    np.testing.assert_allclose(found.strain, [0.0, longer / 1.6 / 2.0**0.5, np.nan], atol=1e-14)
    np.testing.assert_allclose(found.energy, [-1.0, -0.4, np.nan], rtol=1e-12)
    assert found.height_m == pytest.approx(7.5 * 3.0**0.5)
    assert found.mean_strain == pytest.approx(0.75)
    assert found.mean_energy == pytest.approx(2.0)
    assert found.residual_m is None
    assert errors(replace(off, residual={2: 0.1, 8: 0.7}), exact, EDGES, 0.1).residual_m == 0.7


def test_means_scatter_by_what_a_coarser_and_a_perturbed_run_differ():
    """The larger difference counts: for heights the coarser run's, for strain the other's."""
    fine = run(LINE, strain=EIGHT + 0.3)
    coarse = run(LINE, strain=EIGHT + 0.31, heights=np.full((9, 3), 0.2))
    pushed = run(LINE, strain=EIGHT + 0.35, heights=np.full((9, 3), 0.1), total=EIGHT - 4.0)
    found = known([run(LINE), coarse, fine], pushed)
    np.testing.assert_allclose(found.scatter, [0.2, 0.05, 4.0], rtol=1e-12)
    assert (found.strain, found.loaded) == (pytest.approx(0.3), 1.0)


def test_only_times_at_which_positions_are_known_are_compared():
    """In the last frame the runs differ by more than 1e-4 of the size, 3 m: it is left out."""
    def rung(part):
        return run({**dict.fromkeys(range(8), LINE * (1.0 + 1e-5 * part)),
                    8: LINE * (1.0 + 0.1 * part)}, strain=np.linspace(0.0, 0.8, 9))
    found = known([rung(1.0), rung(0.25), rung(0.0625)], run(LINE), (4, 8))
    assert found.frames.tolist() == [4]
    np.testing.assert_allclose(found.x[0], LINE, rtol=1e-14)
    assert 0.0 < found.uncertainty[0] < 1e-4 * 3.0
    assert found.loaded == pytest.approx(0.5)


def test_a_limit_is_extrapolated_by_no_more_than_an_order_of_two_and_a_half():
    runs = [LINE * (1.0 + 16.0**-k) for k in range(3)]
    found, uncertainty = truth.extrapolated(runs)
    last = runs[2] - runs[1]
    np.testing.assert_allclose(found, runs[2] + last / (2.0**2.5 - 1.0), rtol=1e-14)
    assert uncertainty > np.sqrt((runs[2] - LINE)**2).max()


@pytest.mark.parametrize('slowest', [1e-3, 0.2, 0.37, 0.51, 16])
def test_runs_towards_the_limit_halve_the_step(slowest, monkeypatch):
    """Richardson's formula needs that, also where the time of a frame limits the substeps."""
    monkeypatch.setattr(truth, 'SLOWEST', slowest)
    counts = [setting.substeps for setting in truth.own_rungs(load_scene('drape'))]
    assert counts[-1] == 2 * counts[-2] == 4 * counts[-3] >= 4
    assert slowest != 16 or counts[-1] == 8 * counts[0]


@pytest.fixture(scope='module')
def swinging():
    """Return a sheet without damping, which hangs from a corner."""
    return compile_scene(scene_from_mapping({
        'cloths': {'c': {'grid': {'size': [0.6, 0.4], 'resolution': [5, 4]}, 'density': 0.2,
                         'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}}}},
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}}}, where='x', name='x'))


def test_the_energy_of_the_reference_is_that_of_the_start(swinging):
    """The sum of kinetic, elastic and gravitational energy, as the simulation computes it."""
    start, frames = energy(swinging), 6
    x, problem = swinging.frame().x.copy(), problem_of(swinging)
    references = {frames: limit(problem, frames * swinging.frame_dt, 1e-8)}
    track = run(x)
    found = truth.make(swinging, [track] * 3, track, [frames], references, frames, None)
    assert found.kind == truth.INDEPENDENT
    assert found.energy[0] == pytest.approx(start, abs=1e-6)
    assert 0.5 * (swinging.state.mass[swinging.slot] * (
        references[frames].v**2).sum(1)).sum() > 1e-2
    np.testing.assert_array_equal(swinging.frame().x, x)


def test_free_particles_are_pushed_by_a_billionth_of_the_size(swinging):
    before = swinging.frame().x.copy()
    truth.push(swinging)
    moved = np.linalg.norm(swinging.frame().x - before, axis=1)
    assert moved[0] == 0.0
    assert np.sqrt((moved[1:]**2).mean()) == pytest.approx(0.6e-9, rel=0.2)
