"""Where particles lie: each in a slot of its own, rows aligned, and padding that nothing moves."""

import numpy as np
import pytest

from support.scenes import run, with_effects
from support.tiers import slow
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend.simd import BITS, lane_count
from xpbd_ros.sim.particles.memory_layout import APART, blocks, LINE, PAGE, zeros
from xpbd_ros.sim.particles.state import forget, new_state, places, with_solver_storage

DTYPES = pytest.mark.parametrize('dtype', ['float64', 'float32'])
GRIDS = [[(1, 1)], [(1, 9)], [(9, 1)], [(5, 6)], [(33, 17)], [(4, 32)], [(8, 33)],
         [(3, 7), (1, 1), (12, 5), (1, 40), (40, 1)]]


@DTYPES
@pytest.mark.parametrize('shapes', GRIDS)
def test_slots_are_unique_and_inside(shapes, dtype):
    found, slots = blocks(shapes, dtype)
    all_ = np.concatenate([block.slots.ravel() for block in found])
    assert len(np.unique(all_)) == len(all_) == sum(rows * columns for rows, columns in shapes)
    assert all_.min() == 0
    assert all_.max() + lane_count(dtype) < slots + 1
    for block, (rows, columns) in zip(found, shapes):
        assert block.slots.shape == (rows, columns)
        assert block.slots.min() == block.first
        assert block.slots.max() < block.first + block.size
    for before, after in zip(found[:-1], found[1:]):
        assert before.first + before.size == after.first
    assert found[-1].first + found[-1].size + lane_count(dtype) <= slots


@DTYPES
@pytest.mark.parametrize('shapes', GRIDS)
def test_parts_of_rows_begin_on_whole_vectors(shapes, dtype):
    lanes = lane_count(dtype)
    found, slots = blocks(shapes, dtype)
    for block in found:
        for column in range(min(block.parts, block.columns)):
            assert (block.slots[:, column] % lanes == 0).all()
        assert block.row_stride % lanes == 0
        assert block.row_stride * np.dtype(dtype).itemsize // LINE % 2 == 1    # spreads over sets
        assert block.rows_stored >= max(lanes, block.rows)
    assert slots % lanes == 0    # so y and z of a state begin on whole vectors too


@DTYPES
@pytest.mark.parametrize('shape', [*[(n, n) for n in range(1, 40)], (64, 64), (128, 128),
                                   (16, 64), (41, 41)], ids=str)
def test_x_and_y_of_a_particle_avoid_4k_aliasing(shape, dtype):
    found, slots = blocks([shape], dtype)
    apart = slots * np.dtype(dtype).itemsize % PAGE
    assert APART <= apart <= PAGE - APART
    needed = found[-1].first + found[-1].size + lane_count(dtype)
    assert (slots - needed) * np.dtype(dtype).itemsize <= 2 * APART    # no more than that takes


@DTYPES
def test_meshes_lie_between_grids_and_end_on_whole_vectors(dtype):
    lanes = lane_count(dtype)
    rank = np.random.default_rng(1).permutation(37)
    found, slots = blocks([(5, 6), rank, np.zeros(1, int), (1, 1)], dtype)
    all_ = np.concatenate([place.slots.ravel() for place in found])
    assert len(np.unique(all_)) == len(all_) == 30 + 37 + 1 + 1
    np.testing.assert_array_equal(found[1].slots - found[1].first, rank)
    for place, after in zip(found, found[1:]):
        assert place.first % lanes == place.size % lanes == 0
        assert place.slots.max() < place.first + place.size == after.first
    assert found[-1].first + found[-1].size + lanes <= slots


@DTYPES
@pytest.mark.parametrize('columns', [22, 41, 64, 81])
def test_columns_as_far_apart_as_there_are_parts_are_neighbours(columns, dtype):
    (block,), _ = blocks([(6, columns)], dtype)
    assert block.parts >= 4
    assert (np.diff(block.slots, axis=0) == block.row_stride).all()
    assert (block.slots[:, block.parts:] - block.slots[:, :-block.parts] == 1).all()


def test_rows_are_split_for_the_least_padding():
    found, _ = blocks([(2, columns) for columns in (41, 64, 81, 3)], 'float64')
    assert [block.parts for block in found] == [6, 4, 11, 4]
    assert [block.short for block in found] == [True, False, True, True]


@DTYPES
@pytest.mark.parametrize('shape', [(), (1,), (3, 40), (7, 5, 3)])
def test_zeros_begin_on_a_cache_line_and_on_a_vector(shape, dtype):
    for array in [zeros(shape, dtype) for _ in range(20)]:
        assert array.ctypes.data % LINE == 0
        assert array.ctypes.data % (BITS // 8) == 0
        assert array.flags.c_contiguous
        assert (array.dtype, array.shape) == (np.dtype(dtype), shape)
        assert not array.any()


def test_a_new_state_has_mass_only_in_the_slots_of_particles():
    (block,), slots = blocks([(3, 5)], 'float64')
    slot = block.slots.ravel()
    x = np.random.default_rng(1).normal(size=(15, 3))
    state = new_state(x, np.arange(1.0, 16.0), (0, 0, -1), slot, slots, pins=True)
    np.testing.assert_array_equal(places(state.x, slot), x)
    np.testing.assert_array_equal(places(state.x_prev, slot), x)
    np.testing.assert_array_equal(state.mass[slot], np.arange(1.0, 16.0))
    np.testing.assert_array_equal(state.inv_mass[slot], 1.0 / np.arange(1.0, 16.0))
    padding = np.setdiff1d(np.arange(slots), slot)
    for array in (state.x, state.v, state.mass, state.inv_mass, state.mobility, state.reaction):
        assert (array[..., padding] == 0.0).all()
    assert state.history is state.apart is None
    state = with_solver_storage(state, integrator='bdf2', apart=None, constraints=[])
    assert (state.history.fresh == 1.0).all()
    state.history.fresh[:] = 0.0
    forget(state, slot[3])
    assert state.history.fresh.sum() == 1.0
    assert (np.array([array.ctypes.data for array in state[:3]]) % LINE == 0).all()


@pytest.mark.parametrize('method, integrator', [
    ('gauss_seidel', 'backward_euler'), slow('line', 'bdf2')])
@pytest.mark.parametrize('grid', [
    (6, 5), *(pytest.param(grid, marks=pytest.mark.slow) for grid in ((1, 7), (7, 1)))])
def test_nothing_moves_the_padding(grid, method, integrator):
    """It has neither mass nor mobility; whatever passes over it leaves it where it is."""
    simulation = with_effects(grid, substeps=3, iterations=2, method=method,
                                   integrator=integrator)
    state = simulation.state
    padding = np.setdiff1d(np.arange(state.x.shape[1]), simulation.slot)
    run(simulation, 20)
    for array in (state.x, state.v, state.mass, state.inv_mass, state.mobility, state.reaction):
        assert (array[..., padding] == 0.0).all()
    plain = simulation.hash()
    again = with_effects(grid, substeps=3, iterations=2, method=method,
                              integrator=integrator)
    again.state.x[:, padding] = np.random.default_rng(1).normal(size=(3, len(padding)))
    again.state.x_prev[:] = again.state.x
    run(again, 20)
    assert again.hash() == plain


def test_cloths_one_after_another_in_natural_order():
    simulation = compile_scene(scene_from_mapping({
        'solver': {'method': 'gauss_seidel'}, 'cloths': {
            name: {'grid': {'size': [1, 1], 'resolution': resolution}, 'density': 1.0,
                   'pose': {'position': [0.0, 0.0, height]}}
            for name, resolution, height in (('a', [3, 2], 1.0), ('b', [1, 1], 2.0),
                                             ('c', [2, 5], 3.0))}}, where='x', name='x'))
    frame = simulation.frame()
    assert frame.x[:, 2].tolist() == [1.0] * 6 + [2.0] + [3.0] * 10
    np.testing.assert_array_equal(simulation.natural(simulation.state.x), frame.x)
    for cloth in simulation.cloths:
        np.testing.assert_array_equal(simulation.slot[cloth.particles], cloth.slots)
        np.testing.assert_allclose(
            frame.x[cloth.particles] - cloth.mesh.positions, [[0.0, 0.0, {
                'a': 1.0, 'b': 2.0, 'c': 3.0}[cloth.name]]] * len(cloth.slots), atol=1e-15)
