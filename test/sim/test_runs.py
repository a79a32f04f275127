"""Runs: every constraint of a grid once, and what may be projected side by side."""

from collections import Counter
from functools import partial

import numpy as np
import pytest

from support.scenes import numbers, simulate
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend.simd import lane_count
from xpbd_ros.sim.constraints.curvature import curvature_shapes, twist_shapes
from xpbd_ros.sim.constraints.grid_batches import grid_runs, join, listed, Runs, STRIP
from xpbd_ros.sim.constraints.pinned import hold
from xpbd_ros.sim.constraints.pinned_edges import room
from xpbd_ros.sim.particles.memory_layout import blocks

EFFECTS = {'stretch': {'warp': 1.0, 'weft': 1.0}, 'shear': {'stiffness': 1.0},
           'bend': {'stiffness': 1.0}}
GRIDS = [[(1, 1)], [(1, 7)], [(7, 1)], [(2, 2)], [(2, 9)], [(3, 3)], [(4, 2)], [(5, 4)], [(6, 5)],
         [(17, 16)], [(16, 17)], [(9, 2 * STRIP + 3)], [(40, 5)],
         [(3, 4), (1, 1), (6, 5), (1, 6), (5, 1), (7, 7)]]
"""particles along warp and weft of each cloth"""
AROUND = pytest.mark.parametrize('grids', GRIDS)


def spacing(columns, rows, square):
    """Return the sides of a cell: of a sheet 1 m × 1.5 m, or all alike."""
    return (0.1, 0.1) if square else (1.0 / max(columns - 1, 1), 1.5 / max(rows - 1, 1))


def cloths(grids, precision='float64', square=False, **solver):
    """Return cloths with all elastic effects."""
    return compile_scene(scene_from_mapping({
        'solver': {'method': 'gauss_seidel', 'substeps': 1, 'precision': precision, **solver},
        'cloths': {f'c{k}': {'grid': {'size': [d * max(n - 1, 1) for d, n in zip(
            spacing(*grid, square), grid)], 'resolution': list(grid)},
            'density': 1.0, 'effects': EFFECTS}
            for k, grid in enumerate(grids)}}, where='x', name='x'))


def batches(simulation, effect):
    """Return the parts of an effect that have its runs."""
    return [getattr(part, 'edges', part) for part in simulation.effects[effect].parts]


def expected(grids, effect, square=False):
    """Return all constraints, as tuples of particles in natural order, by brute force."""
    found, first = [], 0
    for columns, rows in grids:
        dx, dy = spacing(columns, rows, square)
        particle = partial(lambda start, width, j, c: start + j * width + c, first, columns)
        for j in range(rows):
            for c in range(columns):
                if effect == 'stretch':
                    found += [frozenset((particle(j, c), particle(j + b, c + a)))
                              for a, b in ((1, 0), (0, 1)) if c + a < columns and j + b < rows]
                elif effect == 'shear' and j + 1 < rows and c + 1 < columns:
                    diagonals = [frozenset((particle(j, c), particle(j + 1, c + 1))),
                                 frozenset((particle(j + 1, c), particle(j, c + 1)))]
                    found += diagonals if dx == dy else [diagonals[0] | diagonals[1]]
                elif effect == 'bend':
                    found += [tuple(particle(j + k * b, c + k * a) for k in (0, 1, 2))
                              for a, b in ((1, 0), (0, 1))
                              if c + 2 * a < columns and j + 2 * b < rows]
                    if j + 1 < rows and c + 1 < columns:
                        found.append(tuple(particle(j + b, c + a) for b in (0, 1) for a in (0, 1)))
        first += rows * columns
    return Counter(found)


@AROUND
@pytest.mark.parametrize('precision', ['float64', 'float32'])
@pytest.mark.parametrize('effect, square', [*((name, False) for name in EFFECTS),
                                            ('shear', True)])
def test_every_constraint_of_a_grid_appears_once(effect, square, precision, grids):
    simulation = cloths(grids, precision, square)
    lists = [numbers(simulation, these.particles) for these in simulation.effects[effect].by_part]
    assert all((particles >= 0).all() for particles in lists)
    found = Counter((tuple if effect == 'bend' else frozenset)(p)
                    for particles in lists for p in particles.tolist())
    assert found == expected(grids, effect, square)
    assert not found or set(found.values()) == {1}


@AROUND
@pytest.mark.parametrize('precision', ['float64', 'float32'])
@pytest.mark.parametrize('effect', EFFECTS)
def test_vectors_stay_inside_runs_and_write_no_shared_lanes(effect, precision, grids):
    """A whole vector is stored, lanes past the run's end too: its ends must not overlap."""
    simulation = cloths(grids, precision)
    slots, lanes = simulation.state.x.shape[1], lane_count(precision)
    for runs, r in ((batch.runs, r) for batch in batches(simulation, effect)
                    for r in range(len(batch.runs.start))):
        assert runs.count[r] > 0
        assert runs.rows[r] > 0
        for row in range(runs.rows[r]):
            for q in range(0, runs.count[r], lanes):
                vector = runs.start[r] + row * runs.stride[r] + q + np.arange(lanes)
                touched = (vector[:, None] + runs.offset[r]).ravel()
                assert touched.min() >= 0
                assert touched.max() < slots
                assert len(np.unique(touched)) == len(touched)


@AROUND
@pytest.mark.parametrize('effect', EFFECTS)
def test_every_constraint_has_storage_of_its_own(effect, grids):
    simulation = cloths(grids)
    slots = simulation.state.x.shape[1]
    assert all(batch.force is None for batch in batches(simulation, effect))    # none requested
    keeping = cloths(grids, iterations=2)
    lists = keeping.effects[effect].by_part
    for batch, these in zip(batches(keeping, effect), lists, strict=True):
        runs = batch.runs
        particles, index, shape, place = listed(runs)
        np.testing.assert_array_equal(these.particles, particles)
        assert len(np.unique(index)) == len(index) == len(particles) == len(shape) == len(place)
        if not len(index):
            continue
        assert index.min() >= 0
        assert index.max() < batch.force.shape[-1]
        assert shape.max() < len(batch.compliance)
        assert (batch.compliance[shape, place] > 0.0).all()
        for r in range(len(runs.start)):    # a vector past the run's end stays in the family
            last = (runs.base[r] + runs.start[r] + (runs.rows[r] - 1) * runs.stride[r]
                    + runs.count[r] - 1 + lane_count('float64') - 1)
            assert last < (runs.base[r] // slots + 1) * slots


def test_the_order_is_odd_strips_after_even_strips():
    runs = batches(cloths([(5, 3 * STRIP + 3)]), 'stretch')[0].runs
    (block,), _ = blocks([(3 * STRIP + 3, 5)], 'float64')
    strip = (runs.start - block.first) // block.row_stride // STRIP
    assert list(dict.fromkeys(strip)) == [0, 2, 1, 3]
    assert list(strip[runs.strip[:-1]]) == [0, 2, 1, 3]
    assert runs.strip[-1] == len(runs.start)
    assert list(runs.phase) == [0, 2, 4]
    assert runs.rows.max() == STRIP


@pytest.mark.parametrize('effect', EFFECTS)
def test_strips_of_a_phase_share_no_particle(effect):
    for batch in batches(cloths([(5, 3 * STRIP + 3), (9, 2), (2, 5 * STRIP)]), effect):
        runs = batch.runs
        parts = np.split(np.arange(len(runs.start)), runs.strip[1:-1])
        assert len(parts) == runs.phase[-1]
        for begin, end in zip(runs.phase[:-1], runs.phase[1:]):
            seen = [set(touched(runs, part)) for part in parts[begin:end]]
            assert sum(map(len, seen)) == len(set().union(*seen))


def touched(runs, which) -> np.ndarray:
    """Return the slots that some runs write to."""
    found = [np.zeros(0, int)]
    for r in which:
        along = np.flatnonzero(runs.present[runs.shape[r], runs.place[r]:][:runs.count[r]])
        anchor = runs.start[r] + np.arange(runs.rows[r])[:, None] * runs.stride[r] + along
        found.append((anchor[..., None] + runs.offset[r]).ravel())
    return np.concatenate(found)


def test_a_grid_without_cells_has_no_twist():
    for rows, columns in ((1, 1), (1, 8), (8, 1)):
        (block,), slots = blocks([(rows, columns)], 'float64')
        runs = grid_runs(block, twist_shapes(rows, columns), slots)
        particles, *numbers_ = listed(runs)
        assert particles.shape == (0, 4)
        assert all(column.shape == (0,) for column in numbers_)


def test_joined_runs_are_those_of_one_grid_after_another():
    (a, b), slots = blocks([(3, 4), (5, 2)], 'float64')
    first = grid_runs(a, curvature_shapes(3, 4), slots)
    second = grid_runs(b, curvature_shapes(5, 2), slots, families=2, shapes_before=3)
    together = join([first, second])
    assert isinstance(together, Runs)
    alone = list(listed(second._replace(shape=second.shape - 3)))
    assert len(alone[0]) == 6
    alone[2] += 3
    for k, part in enumerate(listed(together)):
        np.testing.assert_array_equal(part, np.concatenate([listed(first)[k], alone[k]]))


def test_the_list_of_pinned_edges_is_replaced():
    simulation = simulate((4, 1), effects={'stretch': {'compliance': 1.0}},
                          scene_effects={'pin': {}})
    edges = simulation.effects['stretch'].constraints
    count = len(edges.particles)
    assert count == 3
    held = room(count)
    inv_mass = simulation.state.inv_mass.copy()
    inv_mass[simulation.slot[1]] = 0.0
    hold(held, edges, inv_mass)
    assert held.count[0] == 2
    found = numbers(simulation, held.particles[:2])
    assert {frozenset(pair) for pair in found.tolist()} == {frozenset((0, 1)), frozenset((1, 2))}
    np.testing.assert_array_equal(
        numbers(simulation, edges.particles)[np.isin(edges.index, held.index[:2])], found)
    hold(held, edges, simulation.state.inv_mass)
    assert held.count[0] == 0
