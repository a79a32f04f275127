"""Batches from the constraints of each cloth: their arrays in sweep order."""

from collections.abc import Callable
from typing import Any

import numpy as np

from xpbd_ros.sim.constraints.coloured_batches import (
    coloured_packs,
    coloured_runs,
    join_coloured,
)
from xpbd_ros.sim.constraints.grid_batches import by_place, grid_runs, join, Shape
from xpbd_ros.sim.constraints.mesh_batches import pack, padded
from xpbd_ros.sim.constraints.pinned import room_for, stops_for
from xpbd_ros.sim.constraints.projection import max_compliance
from xpbd_ros.sim.particles.memory_layout import Block, zeros


class Packing:
    """
    Constraints of meshes in the order of ``pack``, or coloured, and the arrays of their batch.

    Parameters
    ----------
    particles : slots of the constraints of each cloth, shapes (constraints, particles of each)
    world : build context
    order : the constraint in each place, EMPTY where there is none, in packs of PACK that share no
        particle; None for the order that the scene asks for

    """

    def __init__(self, particles: list[np.ndarray], world, order: np.ndarray | None = None):
        self.particles = np.concatenate(particles)
        self._world, self._dtype = world, world.state.x.dtype
        self._colours = None
        if order is not None:
            self._order = order
        elif world.coloured:
            self._order, self._colours = coloured_packs(self.particles)
        else:
            self._order = pack(self.particles)

    def column(self, numbers: np.ndarray | list[np.ndarray], empty=0.0) -> np.ndarray:
        """
        Return numbers of the constraints as an array of the batch, with the constraints last.

        ``numbers`` are those of all constraints or of each cloth's; ``empty`` is in the padding.
        """
        if isinstance(numbers, list):
            numbers = np.concatenate(numbers)
        found = padded(numbers, self._order, empty, self._dtype)
        return found if found.ndim == 1 else found.T.copy()

    def compliance(self, numbers: list[np.ndarray]) -> np.ndarray:
        """Return compliances as an array of the batch, none above ``max_compliance``."""
        most = max_compliance(self._dtype)
        return self.column(np.minimum(np.concatenate(numbers), most), most)

    def common(self, multipliers: tuple[int, ...] = (), room: Callable = room_for) -> dict:
        """
        Return the fields that all batches have.

        Parameters
        ----------
        multipliers : () for one multiplier each, or (number of multipliers,)
        room : function of the number of constraints, padding included, and of the particles of
            each: returns an empty list for those at pinned particles

        """
        world, (count, width) = self._world, (len(self._order), self.particles.shape[1])
        return {
            'records': world.records,
            'slots': np.array([self.particles.min(initial=world.slots),
                               self.particles.max(initial=-1) + 1]),
            'particles': padded(self.particles, self._order, world.slots - 1, np.int32).T.copy(),
            'force': zeros((*multipliers, count), self._dtype) if world.forces else None,
            'held': room(count, width) if world.pins else None, 'colours': self._colours}


class Rows:
    """
    Constraints of grids in runs, and the arrays of their batch.

    Parameters
    ----------
    blocks : slots of each grid
    shapes_of : function of the numbers of rows and columns: returns the shapes of constraints
    world : build context

    """

    def __init__(self, blocks: list[Block], shapes_of: Callable[[int, int], list[Shape]], world):
        lists = [shapes_of(block.rows, block.columns) for block in blocks]
        families = 1 + max(shape.family for shapes in lists for shape in shapes)
        self.families = [families * n + shape.family
                         for n, shapes in enumerate(lists) for shape in shapes]
        """family of each shape: those of the first grid, of the second, and so on"""
        runs_of: Any = coloured_runs if world.coloured else grid_runs
        runs: list[Any] = [
            runs_of(block, shapes, world.slots, families=families * n,
                    shapes_before=len(shapes) * n)
            for n, (block, shapes) in enumerate(zip(blocks, lists))]
        self.runs: Any = join_coloured(runs) if world.coloured else join(runs)
        self._world, self._size = world, families * len(blocks) * world.slots

    def common(self, compliance: list[np.ndarray], multipliers: tuple[int, ...] = (),
               stops: Callable = stops_for) -> dict:
        """
        Return the fields that all batches have.

        Parameters
        ----------
        compliance : of each grid, by its shapes and places in a row, (shapes, places) or (…, 1)
        multipliers : () for one multiplier each, or (number of multipliers,)
        stops : function of the runs: returns an empty list of constraints at pinned particles

        """
        world, dtype = self._world, self._world.state.x.dtype
        return {
            'runs': self.runs, 'compliance': by_place(self.runs, compliance, dtype),
            'force': zeros((*multipliers, self._size), dtype) if world.forces else None,
            'stops': stops(self.runs) if world.pins else None}
