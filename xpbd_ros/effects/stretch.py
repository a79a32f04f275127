"""
Stretch: elastic edges along warp and weft of a grid, or along all edges of a mesh.

C = |x1 - x2| - L (``constraints.distance``); the method ``line`` solves whole lines of grids
(``constraints.line_solver``), and of other meshes whole paths (``constraints.mesh_paths``).

On a grid of cells dx × dy an edge along warp has the stiffness k = warp dy / dx [N/m], one along
weft k = weft dx / dy, and half of it at the rim, so that the sheet has the given moduli at any
resolution (doc/numerics.md 5.2). With ``shear`` the lattice has C11 = warp + shear on square
cells. On any other mesh each triangle of area A adds k = (warp cos²θ + weft sin²θ) A / l² to its
edge of length l, at an angle θ from warp (Van Gelder 1998, whose isotropic lattice this is for
warp = weft). Instead of moduli, ``compliance`` [m/N] gives every edge the same; 0 is rigid.

A rigid line between two pins further apart than its length is placed straight, with edges of equal
length (``constraints.overextended_lines``).

Limits: as a lattice it has no free Poisson's ratio: 0 on a grid, about 1/3 on other meshes. With
fewer substeps than a wave needs to cross an edge it is softer than given (doc/numerics.md 4.1).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.threads import alone_on_device, wait_on_device
from xpbd_ros.sim.constraints import distance, line_solver, mesh_paths, overextended_lines
from xpbd_ros.sim.constraints.grid_batches import Shape
from xpbd_ros.sim.constraints.projection import zero_multipliers
from xpbd_ros.sim.effect import Built, by_kind, Effect, is_grid
from xpbd_ros.sim.geometry.mesh import edge_areas
from xpbd_ros.sim.parameters import need_one_or_two, quantity
from xpbd_ros.sim.stepping.constraint_stages import elastic_edges
from xpbd_ros.sim.stepping.stages import prepare, solve_lines, stage


@dataclass(frozen=True)
class Parameters:
    """Either moduli along warp and weft, or one compliance."""

    warp: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus along warp')
    weft: float | None = quantity(None, unit='N/m', above=0.0, live=True,
                                  doc='modulus along weft')
    compliance: float | None = quantity(None, unit='m/N', minimum=0.0, live=True,
                                        doc='compliance of every edge; 0 is rigid')

    def __post_init__(self):
        """Require exactly one of the two forms."""
        need_one_or_two(self.compliance, (self.warp, self.weft), both='warp and weft (N/m)',
                        either='warp and weft (N/m) or compliance (m/N)')


@elastic_edges
class Stretch(NamedTuple):
    """Data of the kernels for grids."""

    edges: distance.GridEdges
    lines: line_solver.Lines
    taut: overextended_lines.Taut | None
    """None in a scene without pins"""


@elastic_edges
class MeshStretch(NamedTuple):
    """Data of the kernels for other meshes."""

    edges: distance.MeshEdges


@elastic_edges
class PathStretch(NamedTuple):
    """Data of the kernels for other meshes, with the method ``line``."""

    edges: distance.MeshEdges
    paths: mesh_paths.Paths


@stage(prepare, Stretch, on_device=True)
@jit
def prepare_stretch(stretch, state, substep):
    """Zero the multipliers, except of overextended lines."""
    zero_multipliers(state.apart, stretch.edges.force, state.team)
    wait_on_device(state.team)
    if alone_on_device(state.team):
        overextended_lines.straighten(stretch.taut, stretch.lines, stretch.edges.force, state)


@stage(prepare, PathStretch)
@jit
def prepare_path_stretch(stretch, state, substep):
    """Zero the multipliers."""
    zero_multipliers(state.apart, stretch.edges.force, state.team)


@stage(solve_lines, Stretch, shared=True)
@jit
def solve_stretch(stretch, state, substep):
    """Solve every line."""
    line_solver.solve_edges(stretch.lines, stretch.edges, state, substep)


@stage(solve_lines, PathStretch)
@jit
def solve_path_stretch(stretch, state, substep):
    """Solve every path."""
    mesh_paths.solve_paths(stretch.paths, stretch.edges, state, substep)


def edge_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the shapes of warp edges, inside and along the rim, and of weft edges."""
    inside, rim = (range(1, rows - 1), range(0, rows, rows - 1)) if rows > 1 else (
        range(1), range(0))
    return [Shape(((0, 0), (0, 1)), inside, range(columns - 1), 0),
            Shape(((0, 0), (0, 1)), rim, range(columns - 1), 0),
            Shape(((0, 0), (1, 0)), range(rows - 1), range(columns), 1)]


def _compliance(given, modulus, along: float, across: float, lines: int) -> np.ndarray:
    """Return the compliance of the edges of each line [m/N], shape (lines,)."""
    if given is not None:
        return np.full(lines, given)
    share = np.ones(lines)
    if lines > 1:
        share[[0, -1]] = 0.5
    with np.errstate(over='ignore', divide='ignore'):
        return along / (modulus * (share * across))


def _on_grids(cloths, world) -> Stretch:
    """Return warp and weft edges; those along the rim have half of the stiffness."""
    rest, alpha, line_alpha = [], [], []
    for cloth, chosen in cloths:
        block, (dx, dy) = cloth.block, cloth.mesh.spacing
        by_row = _compliance(chosen.compliance, chosen.warp, dx, dy, block.rows)
        by_column = _compliance(chosen.compliance, chosen.weft, dy, dx, block.columns)
        rest.append([dx, dx, dy])
        table = np.zeros((3, block.row_stride))
        table[0], table[1] = by_row[len(by_row) // 2], by_row[0]
        table[2, block.slots[0] - block.first] = by_column
        alpha.append(world.compliance_scale * table)
        line_alpha.append((world.compliance_scale * by_row, world.compliance_scale * by_column))
    blocks = [cloth.block for cloth, _ in cloths]
    return Stretch(
        distance.grid_edges(blocks, edge_shapes, rest, alpha, world=world,
                            time=distance.times(cloths, world)),
        line_solver.grid_lines(blocks, [cloth.mesh.spacing for cloth, _ in cloths], line_alpha,
                               slots=world.slots, dtype=world.state.x.dtype,
                               threads=world.threads),
        overextended_lines.room_for(blocks) if world.pins else None)


def _on_meshes(cloths, world) -> MeshStretch | PathStretch:
    """Return all edges of meshes, along paths where the solver may solve these."""
    particles, rest, alpha = [], [], []
    for cloth, chosen in cloths:
        mesh, ends = cloth.mesh, cloth.mesh.edges
        d = mesh.positions[ends[:, 1]] - mesh.positions[ends[:, 0]]
        square = (d**2).sum(1)
        particles.append(cloth.slots[ends])
        rest.append(np.sqrt(square))
        if chosen.compliance is not None:
            alpha.append(np.full(len(ends), world.compliance_scale * chosen.compliance))
        else:
            along = (d @ mesh.warp)**2 / square
            area = edge_areas(mesh.triangles, ends, mesh.positions)
            if not area.all():
                raise InputError(f'cloths.{cloth.name}.effects.stretch: warp and weft (N/m) are '
                                 f'of a surface, and {np.sum(area == 0.0)} edges are inside a '
                                 'body; give compliance (m/N), or the effect volume')
            alpha.append(world.compliance_scale * square / (
                area * (chosen.warp * along + chosen.weft * (1.0 - along))))
    time = distance.times(cloths, world)
    if world.lines and world.coloured:
        raise InputError('solver.order: coloured does not go with the paths that the methods line '
                         'and auto solve on meshes; take order sequential, or method gauss_seidel')
    if not world.lines or time is not None:
        return MeshStretch(distance.mesh_edges(particles, rest, alpha, world=world, time=time))
    x = np.zeros((world.slots, 3))
    for cloth, _ in cloths:
        x[cloth.slots] = cloth.mesh.positions
    cover = mesh_paths.cover(np.concatenate(particles), x)
    edges = distance.mesh_edges([cover.particles], rest, alpha, world=world, order=cover.order)
    return PathStretch(edges, mesh_paths.paths_of(cover, edges))


class BuiltStretch(Built):
    """The edges of all cloths with this effect, of grids and of other meshes."""

    def __init__(self, parameters, world):
        super().__init__()
        parts: list[Any] = [make(cloths, world) for make, cloths in zip(
            (_on_grids, _on_meshes), by_kind(parameters, is_grid)) if cloths]
        self.data, *self.also = parts
        self._blocks = [cloth.block for cloth in parameters if is_grid(cloth.mesh)]
        self.lists = [distance.Edges.of(part.edges) for part in parts]
        self.constraints = distance.Edges.joined(self.lists)
        if any(isinstance(part, PathStretch) for part in parts):
            self.packs = np.concatenate([
                mesh_paths.packs_of(part.paths, edges.index) if isinstance(part, PathStretch)
                else np.zeros(len(edges.index), int) for part, edges in zip(parts, self.lists)])
        self.loaded_edges = [(part.edges.force, edges) for part, edges in zip(parts, self.lists)
                             if part.edges.force is not None]

    def hold(self, inv_mass):
        super().hold(inv_mass)
        if self._blocks:
            overextended_lines.hold(self.data.taut, self._blocks, inv_mass)
        for part in self.parts:
            if isinstance(part, PathStretch):
                mesh_paths.hold(part.paths)


EFFECT = Effect('stretch', Parameters, BuiltStretch)
