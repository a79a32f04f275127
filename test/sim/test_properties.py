"""What holds for any cloth, material, step and order of commands; found by hypothesis."""

import tempfile
from types import FunctionType

from hypothesis import assume, given, HealthCheck, settings, strategies as st
import numpy as np
import pytest

from support.meshes import disc, obj_text
from support.scenes import EXAMPLES, simulate, USUAL
from xpbd_ros.effects import EFFECTS
from xpbd_ros.sim import measure
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    ReleaseAll,
    Reset,
    SetKey,
)

METHODS = [('gauss_seidel', 'backward_euler'), ('line', 'bdf2')]
magnitudes = st.floats(-6.0, 6.0).map(lambda e: 10.0**e)
"""twelve decades"""
places = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
names = st.sampled_from(['a', 'b', 'c'])
commands = st.one_of(
    st.builds(lambda n, p, r: Grasp(n, Pose(p), r), names, places, st.floats(1e-3, 3.0)),
    st.builds(lambda n, p: MovePin(n, Pose(p)), names, places),
    st.builds(Release, names), st.just(ReleaseAll()), st.just(Reset()),
    st.builds(lambda p: MoveCollider('table', Pose(p)), places),
    st.builds(lambda g: SetKey('gravity', list(g)), places),
    st.builds(lambda k: SetKey('cloths.c.effects.stretch.warp', k), magnitudes),
    st.builds(lambda k: SetKey('solver.compliance_scale', k), magnitudes),
    st.builds(lambda n: SetKey('solver.substeps', n), st.integers(1, 12)))


@st.composite
def cloths(draw, every=True):
    """
    Return the options of a cloth with the usual effects.

    Square cells and each method have a step of their own to compile; not ``every`` scene has one
    that other tests compile as well.
    """
    warp, weft, shear = (draw(magnitudes) for _ in range(3))
    values = {**EXAMPLES, 'stretch': {'warp': warp, 'weft': weft}, 'shear': {'stiffness': shear},
              'bend': {'stiffness': draw(magnitudes) * 1e-3},
              'damping': {'rate': draw(magnitudes)}}
    kinds = {scope: {name: values[name] for name in USUAL if EFFECTS[name] == scope}
             for scope in ('cloth', 'scene')}
    method, integrator = draw(st.sampled_from(METHODS if every else METHODS[:1]))
    scale = draw(magnitudes)
    kinds['scene']['contact'] = {'thickness': draw(st.floats(1e-4, 0.1))}
    grids = st.tuples(*[st.integers(3, 7)] * 2)
    if not every:
        grids = grids.filter(lambda grid: grid[0] != grid[1])
    return {'grid': draw(grids), 'size': (scale, scale),
            'density': draw(magnitudes), 'effects': kinds['cloth'],
            'scene_effects': kinds['scene'], 'method': method, 'integrator': integrator,
            'substeps': draw(st.integers(1, 6)), 'iterations': draw(st.integers(1, 3)),
            'rate': draw(st.sampled_from([1.0, 30.0, 60.0, 1000.0])),
            'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}},
            'colliders': {'table': {'plane': {}, 'position': [0.0, 0.0, -0.1 * scale]}}}


def some(count: int, slow: int, **strategies):
    """
    Return a decorator: tests of so many examples, and of many more that is slow.

    ``options`` is a function of whether every scene may come: in the slow one.
    """
    def both(test):
        found = []
        for examples, marks in ((count, ()), (slow, pytest.mark.slow)):
            if 'options' in strategies:
                mine = {**strategies, 'options': strategies['options'](bool(marks))}
            else:
                mine = strategies
            again = FunctionType(test.__code__, test.__globals__, test.__name__)
            found.append(pytest.param(settings(
                max_examples=examples, deadline=None, derandomize=True, database=None,
                suppress_health_check=list(HealthCheck))(given(**mine)(again)),
                id=f'{examples} examples', marks=marks))
        return found
    return both


@some(12, 1500, options=cloths,
      story=st.lists(st.lists(commands, max_size=3), min_size=3, max_size=12))
def stays_finite(options, story):
    """Whatever is asked for: finite, a time that rises, and the same bits when repeated."""
    hashes = []
    for _ in range(2):
        simulation, last = simulate(**options), -1
        for asked in story:
            frame = simulation.step(asked)
            assert np.isfinite(frame.x).all()
            assert np.isfinite(frame.v).all()
            assert len(frame.applied) + len(frame.refused) == len(asked)
            assert frame.time_ns > last
            last = frame.time_ns
        assert simulation.stats()['frames_taken_back'] == 0
        hashes.append(simulation.hash())
    assert hashes[0] == hashes[1]


@some(8, 600, options=cloths, seed=st.integers(0, 2**32 - 1))
def keeps_momentum_and_gains_no_energy(options, seed):
    """A free cloth without gravity, strained and thrown anyhow."""
    options = {**options, 'pins': {}, 'gravity': (0.0, 0.0, 0.0), 'iterations': 1,
               'integrator': 'backward_euler', 'method': 'gauss_seidel'}
    options['scene_effects'] = {**options['scene_effects'], 'damping': {'rate': 1e-300},
                                'contact': {'thickness': 1e-4}}
    options['colliders'] = {'table': {'plane': {}, 'position': [0.0, 0.0,
                                                                -1e9 * options['size'][0]]}}
    simulation = simulate(**options)
    noise, state, slot = np.random.default_rng(seed), simulation.state, simulation.slot
    size = options['size'][0]
    state.x[:, slot] += noise.normal(0.0, 0.02 * size, (3, len(slot)))
    state.v[:, slot] = noise.normal(0.0, size, (3, len(slot)))

    def energy():
        return measure.kinetic_energy(state) + measure.elastic_energy(simulation)

    before, start = measure.momentum(state), energy()
    most = np.abs(state.mass[slot] * state.v[:, slot]).sum()
    for _ in range(5):
        simulation.step()
        assert np.abs(measure.momentum(state) - before).max() <= 1e-9 * max(
            most, np.abs(state.mass[slot] * state.v[:, slot]).sum() * 60.0)
        assert measure.kinetic_energy(state) <= 1.001 * start


def after_four_frames(options, **changes):
    """Return where the particles are then."""
    simulation = simulate(**{**options, **changes})
    for _ in range(4):
        frame = simulation.step()
    return frame.x


@some(5, 300, options=cloths, power=st.integers(-20, 20))
def does_not_depend_on_units(options, power):
    """Masses and stiffnesses times a power of two."""
    by = 2.0**power
    effects = {name: {key: value * by for key, value in keys.items()}
               for name, keys in options['effects'].items()}
    np.testing.assert_allclose(
        after_four_frames(options, density=options['density'] * by, effects=effects),
        after_four_frames(options), rtol=0.0, atol=1e-9 * options['size'][0])


@some(5, 300, options=cloths, power=st.integers(-20, 20))
def does_not_depend_on_the_unit_of_length(options, power):
    """
    What has a length in it times a power of two; N/m and kg have none, N m has two.

    Only what is too deep from the start comes out at a speed in m/s, whatever its size.
    """
    def found(by):
        thickness = {'contact': {'thickness': 0.05 * options['size'][0] * by}}
        return after_four_frames(
            options, size=tuple(by * side for side in options['size']),
            effects={**options['effects'], 'bend': {
                'stiffness': options['effects']['bend']['stiffness'] * by**2}},
            scene_effects={**options['scene_effects'], **thickness},
            density=options['density'] / by**2, gravity=(0.0, 0.0, -9.80665 * by),
            colliders={'table': {'plane': {}, 'position': [
                0.0, 0.0, -0.1 * options['size'][0] * by]}})

    by = 2.0**power
    assume(by * max(options['size']) < 5e8)    # m: no scene is larger
    np.testing.assert_allclose(found(by) / by, found(1.0), rtol=0.0,
                               atol=1e-9 * options['size'][0])


@some(5, 300, options=cloths, angle=st.floats(-3.0, 3.0).map(lambda x: round(x, 6)),
      shift=st.tuples(*[st.floats(-3.0, 3.0).map(lambda x: round(x, 6))] * 2))
def does_not_depend_on_where_it_is(options, angle, shift):
    """Turned about the vertical, and moved along the table."""
    size = options['size'][0]
    pose = {'position': [shift[0] * size, shift[1] * size, 0.0],
            'orientation': [0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)]}
    c, s = np.cos(angle), np.sin(angle)
    got = (after_four_frames(options, pose=pose) - pose['position']) @ np.array(
        [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    x = after_four_frames(options)
    np.testing.assert_allclose(got, x, rtol=0.0, atol=1e-9 * max(size, np.abs(x).max()))


@some(2, 60, seed=st.integers(0, 2**32 - 1), stiffness=st.floats(10.0, 1000.0))
def does_not_depend_on_the_order(seed, stiffness):
    """
    The vertices and triangles of a mesh in another order, so another sweep.

    What a sweep does depends on its order, and in XPBD it does at the end of many too, since each
    constraint pulls along where it was at its turn. Both fall with the square of the substep.
    """
    random = np.random.default_rng(seed)
    vertices, triangles = disc(2)
    vertices = vertices + random.normal(0.0, 0.02, vertices.shape)
    order = random.permutation(len(vertices))    # of the vertices, as they come in the second
    number = np.argsort(order)

    kick = random.normal(0.0, 0.3, vertices.shape)

    def after(order, number, triangles, substeps):
        with tempfile.NamedTemporaryFile('w', suffix='.obj') as file:
            file.write(obj_text(vertices[order], number[triangles]))
            file.flush()
            simulation = simulate(mesh=file.name, substeps=substeps, effects={
                'stretch': {'warp': stiffness, 'weft': stiffness}})
        simulation.state.v[:, simulation.slot] = kick[order].T
        for _ in range(6):
            frame = simulation.step()
        return frame.x[number]

    same = np.arange(len(vertices))
    off = [np.abs(after(same, same, triangles, count) - after(
        order, number, random.permutation(triangles), count)).max() for count in (16, 64, 256)]
    assert off[0] > 1e-7
    assert off[1] < 0.2 * off[0]
    assert off[2] < 0.2 * off[1]


@pytest.mark.parametrize('run', stays_finite)
def test_stays_finite_and_repeats_whatever_is_asked(run):
    run()


@pytest.mark.parametrize('run', keeps_momentum_and_gains_no_energy)
def test_a_free_cloth_keeps_its_momentum_and_gains_no_energy(run):
    run()


@pytest.mark.parametrize('run', does_not_depend_on_units)
def test_units_of_mass_do_not_matter(run):
    run()


@pytest.mark.parametrize('run', does_not_depend_on_the_unit_of_length)
def test_units_of_length_do_not_matter(run):
    run()


@pytest.mark.parametrize('run', does_not_depend_on_the_order)
def test_the_order_of_a_mesh_matters_within_the_sweep_error(run):
    run()


@pytest.mark.parametrize('run', does_not_depend_on_where_it_is)
def test_places_and_directions_do_not_matter(run):
    run()
