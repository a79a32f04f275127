"""The coloured order: every constraint once, none at a common particle within a colour."""

from collections import Counter

import numpy as np
import pytest

from sim.test_packs import AROUND as AROUND_LISTS, LISTS
from sim.test_runs import EFFECTS, GRIDS
from support.scenes import disc_file, EXAMPLES
from support.tiers import quick_only, slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.sim.constraints.coloured_batches import coloured_packs
from xpbd_ros.sim.constraints.distance import Edges
from xpbd_ros.sim.constraints.mesh_batches import EMPTY
from xpbd_ros.sim.measure import momentum

BATCHES = [*EFFECTS, 'area', 'membrane', 'hinge']
FEW = {'stretch': EFFECTS['stretch']}
BOTH = [(6, 5), None]
"""a grid and a mesh; with FEW, one step for most of the tests"""


def cloths(shapes, *, effects=EFFECTS, pin=False, gravity=-9.80665, **solver):
    """Return cloths in the coloured order: grids of a resolution, or discs (None)."""
    return compile_scene(scene_from_mapping({
        'gravity': [0.0, 0.0, gravity],
        'solver': {'method': 'gauss_seidel', 'substeps': 2, 'order': 'coloured',
                   'integrator': 'backward_euler', **solver},
        'cloths': {f'c{k}': {
            **({'mesh': {'file': disc_file()}} if shape is None else
               {'grid': {'size': [0.1 * max(n - 1, 1) for n in shape],
                         'resolution': list(shape)}}),
            'density': 1.0, 'effects': {
                name: keys for name, keys in effects.items() if shape or name != 'shear'}}
            for k, shape in enumerate(shapes)},
        'effects': {'pin': {}},
        **({'pins': {'a': {'cloth': f'c{len(shapes) - 1}', 'at': [0]}}} if pin else {}),
    }, where='x', name='x'))


def crumpled(simulation, seed=0):
    """Return the simulation with every free particle displaced."""
    slot, state = simulation.slot, simulation.state
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (3, len(slot)))
    state.x[:, slot] += (noise * (state.inv_mass[slot] > 0.0)).astype(state.x.dtype)
    return simulation


def by_colour(batch, these):
    """Return the numbers in ``these`` of the constraints of each colour."""
    if hasattr(batch, 'particles'):
        ends = np.searchsorted(these.index, batch.colours)
    else:
        runs = batch.runs
        size = [runs.rows[r] * runs.present[runs.shape[r], runs.place[r]:][:runs.count[r]].sum()
                for r in range(len(runs.start))]
        ends = np.concatenate([[0], np.cumsum(size)]).astype(int)[runs.colour]
    return [slice(*pair) for pair in zip(ends, ends[1:])]


@pytest.mark.parametrize('shapes', [*GRIDS, [None, (5, 4), (9, 7), None]])
def test_no_two_constraints_of_a_colour_share_a_particle(shapes):
    effects = EFFECTS if None not in shapes else {name: EXAMPLES[name] for name in BATCHES}
    ours = cloths(shapes, effects=effects)
    usual = cloths(shapes, effects=effects, order='sequential')
    for name in effects:
        for part, these, those in zip(ours.effects[name].parts, ours.effects[name].by_part,
                                      usual.effects[name].by_part, strict=True):
            batch = getattr(part, 'edges', part)
            colours = by_colour(batch, these)
            assert sum(len(these.particles[one]) for one in colours) == len(these.particles)
            for one in colours:
                touched = these.particles[one].ravel()
                assert len(np.unique(touched)) == touched.size > 0
            assert Counter(map(frozenset, these.particles.tolist())) == Counter(
                map(frozenset, those.particles.tolist()))
            assert len(np.unique(these.index)) == len(these.index)


def test_a_sheet_has_few_colours():
    found = {name: [len(getattr(part, 'edges', part).runs.colour) - 1
                    for part in built.parts]
             for name, built in cloths([(40, 30)]).effects.items() if name in EFFECTS}
    assert found['stretch'][0] <= 6
    assert found['shear'][0] == 4
    assert max(found['bend']) <= 10


@AROUND_LISTS
def test_colours_partition_the_constraints_of_a_mesh(name):
    particles = LISTS[name]
    order, first = coloured_packs(particles)
    assert first[0] == 0 and first[-1] == len(order)
    assert (first % PACK == 0).all()
    np.testing.assert_array_equal(np.sort(order[order != EMPTY]), np.arange(len(particles)))
    for begin, end in zip(first, first[1:]):
        members = order[begin:end]
        count = (members != EMPTY).sum()
        assert (members[:count] != EMPTY).all()
        touched = particles[members[:count]].ravel()
        assert 0 < len(np.unique(touched)) == len(touched)


def project(x, m, these, one):
    """Project the constraints ``one`` of a list at once, from their definitions, in float64."""
    p, alpha = these.particles[one], these.compliance[one]
    if isinstance(these, Edges):
        d = x[p[:, 0]] - x[p[:, 1]]
        l = np.linalg.norm(d, axis=1)
        weight, c = np.array([[1.0, -1.0]]), (l - these.rest_length[one])[:, None]
        way = d / l[:, None]
    else:
        weight = these.weight[one]
        c, way = np.einsum('cp,cpk->ck', weight, x[p]), None
    total = (weight**2 * m[p]).sum(1)
    there = total > 0.0
    f = -c / (np.where(there, total, 1.0) + alpha)[:, None] * there[:, None]
    move = f * way if way is not None else f
    for k in range(p.shape[1]):
        x[p[:, k]] += (m[p[:, k]] * np.broadcast_to(weight, p.shape)[:, k])[:, None] * move


def frame_by_definition(simulation, x, v):
    """Return x and v one frame later, shape (slots, 3), colour after colour in NumPy."""
    h = simulation.frame_dt / simulation.solver.substeps
    w = simulation.state.inv_mass.astype(float)
    free = (w > 0.0)[:, None]
    for _ in range(simulation.solver.substeps):
        start = x
        v = np.where(free, v + h * simulation.state.gravity, v)
        x = np.where(free, x + h * v, x)
        for built in simulation.effects.values():
            for part, these in zip(built.parts, built.by_part):
                for one in by_colour(getattr(part, 'edges', part), these):
                    project(x, w * h * h, these, one)
        v = (x - start) / h
    return x, v


@pytest.mark.parametrize('shapes, effects', [
    (BOTH, FEW), slow(BOTH, EFFECTS, id='all'), slow([(33, 18), (1, 9)], EFFECTS, id='large')])
def test_a_frame_is_the_definition_colour_after_colour(shapes, effects):
    simulation = crumpled(cloths(shapes, effects=effects, pin=True))
    x, v = (array.T.astype(float) for array in (simulation.state.x, simulation.state.v))
    before = x[simulation.slot]
    for _ in range(2):
        x, v = frame_by_definition(simulation, x, v)
        simulation.step()
    moved = np.abs(x[simulation.slot] - before).max()
    assert moved > 5e-3
    np.testing.assert_allclose(simulation.frame().x, x[simulation.slot], atol=1e-12 * moved)
    np.testing.assert_allclose(simulation.frame().v, v[simulation.slot], atol=1e-9)


def hashes(threads, shapes, frames=3, effects=FEW, **options):
    simulation = crumpled(cloths(shapes, threads=threads, pin=True, effects=effects, **options))
    found = []
    for _ in range(frames):
        simulation.step()
        found.append(simulation.hash())
    return found


@pytest.mark.parametrize('options', quick_only(
    [{}, {'effects': EFFECTS},
     {'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2', 'precision': 'float32'},
     {'method': 'jacobi', 'iterations': 2}, {'precision': 'float32', 'substeps': 60},
     {'method': 'explicit', 'integrator': 'leapfrog', 'substeps': 300}], {}))
def test_the_same_bits_with_any_number_of_threads(options):
    one = hashes(1, [(19, 43), None], **options)
    assert hashes(3, [(19, 43), None], **options) == one
    assert len(set(one)) == len(one)


@pytest.mark.slow
def test_the_order_is_another_one():
    assert hashes(1, BOTH) != hashes(1, BOTH, order='sequential')


def test_momentum_is_kept():
    simulation = crumpled(cloths(BOTH, effects=FEW, gravity=0.0))
    for _ in range(3):
        simulation.step()
    scale = float(simulation.state.mass.sum()) * np.abs(simulation.state.v).max()
    assert scale > 0.01
    assert np.abs(momentum(simulation.state)).max() < 1e-12 * scale


def test_pins_carry_the_weight():
    """At rest the reaction is the weight: constraints at pins are found colour by colour."""
    simulation = cloths([(1, 1), None], effects=FEW, pin=True, substeps=30)
    for _ in range(500):
        simulation.state.v[:] *= 0.9
        frame = simulation.step()
    weight = 9.80665 * float(simulation.state.mass[simulation.cloths[1].slots].sum())
    force = np.array(frame.pins['a'].force)
    np.testing.assert_allclose(force, [0.0, 0.0, -weight], atol=2e-2 * weight)


@pytest.mark.parametrize('method', ['line', 'auto'])
def test_paths_of_meshes_are_refused(method):
    with pytest.raises(InputError, match=r'solver\.order: coloured does not go with the paths'):
        cloths([None], method=method, integrator='bdf2')
