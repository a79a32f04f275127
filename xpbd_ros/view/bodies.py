"""Colliders as nodes of viser's scene."""

from pathlib import Path

import numpy as np
import trimesh

from xpbd_ros.scene.mesh_file import read_mesh_file, read_table

COLOUR = (154, 163, 173)
GRID_EXTENT = 6.0
"""side of a plane's grid, over the size of the scene"""


def add_body(scene, path: str, entry, pose: dict, size: float):
    """
    Return the node of a collider.

    Parameters
    ----------
    scene : viser's scene
    path : name of the node
    entry : the collider's entry in the scene file
    pose : position and wxyz
    size : size of the cloths [m]

    """
    shape = getattr(entry, entry.shape)
    if entry.shape == 'plane':
        extent = GRID_EXTENT * size
        return scene.add_grid(path, width=extent, height=extent, plane='xy', cell_size=0.1,
                              section_size=0.5, cell_color=(228, 230, 233),
                              section_color=(190, 195, 200), plane_color=(247, 247, 248),
                              plane_opacity=0.9,
                              **pose)
    if entry.shape == 'sphere':
        return scene.add_icosphere(path, shape.radius, subdivisions=4, color=COLOUR, **pose)
    if entry.shape == 'box':
        return scene.add_box(path, dimensions=tuple(shape.size), color=COLOUR, **pose)
    if entry.shape == 'cylinder':
        return scene.add_cylinder(path, radius=shape.radius, height=shape.length,
                                  radial_segments=48, color=COLOUR, **pose)
    vertices, triangles = surface_of(entry.shape, shape)
    return scene.add_mesh_simple(path, vertices.astype(np.float32), triangles, color=COLOUR,
                                 side='double', flat_shading=entry.shape == 'mesh', **pose)


def surface_of(kind: str, shape) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m] and triangles of a capsule, a mesh or a height field."""
    if kind == 'capsule':
        mesh = trimesh.creation.capsule(shape.length, shape.radius)
        return mesh.vertices - [0.0, 0.0, 0.5 * shape.length], mesh.faces
    if kind == 'mesh':
        vertices, triangles, _ = read_mesh_file(Path(shape.file))
        return shape.scale * vertices, triangles
    heights = shape.scale * (read_table(shape.file) if shape.values is None
                             else np.array(shape.values, float))
    rows, columns = heights.shape
    x, y = (np.linspace(-0.5 * extent, 0.5 * extent, count)
            for extent, count in zip(shape.size, (columns, rows)))
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    triangles = np.concatenate([
        np.column_stack([corner, corner + 1, corner + columns]),
        np.column_stack([corner + 1, corner + columns + 1, corner + columns])])
    return np.column_stack([np.tile(x, rows), np.repeat(y, columns), heights.ravel()]), triangles
