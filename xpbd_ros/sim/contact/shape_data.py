"""Distance fields and heights of colliders."""

from collections.abc import Mapping

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.contact.collider import Placed
from xpbd_ros.sim.contact.collider_entries import Body, Entry, table
from xpbd_ros.sim.contact.distance_field import (
    distance_field,
    Field,
    MOST_NODES,
    NoRoomError,
)


def shape_data(entries: Mapping[str, Entry], thickness: float,
               world) -> dict[str, Field | np.ndarray]:
    """
    Return the distance fields and heights of collider entries, by name.

    Parameters
    ----------
    entries : a scene's colliders, by name
    thickness : distance kept from surfaces [m]
    world : reads files of meshes and of heights

    """
    found: dict[str, Field | np.ndarray] = {}
    for name, entry in entries.items():
        keys = entry.mesh or entry.heights
        if keys is None:
            continue
        try:
            if isinstance(keys, Body):
                vertices, triangles = world.read_mesh(keys.file)
                found[name] = distance_field(vertices * keys.scale, triangles,
                                             gap=thickness, spacing=keys.spacing)
            else:
                rows = keys.values if keys.file is None else world.read_table(keys.file)
                found[name] = keys.scale * table(rows)
        except InputError as error:
            file = f'{keys.file}: ' if keys.file and keys.file not in str(error) else ''
            raise InputError(f'colliders.{name}.{entry.shape}: {file}{error}') from None
    return found


def for_thickness(shapes: Mapping[str, Field | np.ndarray], placed: Mapping[str, Placed],
                  thickness: float, spare: int) -> tuple[dict[str, Field | np.ndarray],
                                                         dict[str, Field]]:
    """
    Return the same as ``shape_data``, and the fields of placed colliders, for another thickness.

    Parameters
    ----------
    shapes : those of the scene's colliders, by name
    placed : the colliders that there are, by name
    thickness : distance kept from surfaces [m]
    spare : room for nodes of grids besides that of ``shapes``

    Raises
    ------
    InputError : a mesh is too thin for it, or placed meshes have no room

    """
    fields = {name: each.field for name, each in placed.items() if each.field is not None}
    new: dict[Field, Field] = {}
    for name, field in (*shapes.items(), *fields.items()):
        if isinstance(field, Field) and field not in new:
            try:
                new[field] = field.for_gap(thickness)
            except InputError as error:
                raise InputError(f"effects.contact.thickness: collider '{name}' {error} (got "
                                 f'{thickness:g} m)') from None
    found = {name: new[shape] if isinstance(shape, Field) else shape
             for name, shape in shapes.items()}
    fields = {name: new[field] for name, field in fields.items()}
    missing = sum(field.values.size for field in fields.values()) - spare - sum(
        shape.values.size for shape in found.values() if isinstance(shape, Field))
    if missing > 0:
        raise InputError(f'effects.contact.thickness: the grids of meshes for {thickness:g} m '
                         f'have no room; raise effects.contact.mesh_nodes by {missing}')
    return found, fields


def placed_field(corners: tuple[float, ...], thickness: float, room: int) -> Field:
    """
    Return the distance field of a mesh that a command places.

    Parameters
    ----------
    corners : x, y, z of each triangle's corners [m]
    thickness : distance kept from surfaces [m]
    room : for nodes of its grid

    Raises
    ------
    InputError : it cannot be a collider, or has no room

    """
    vertices = np.array(corners).reshape(-1, 3)
    try:
        return distance_field(vertices, np.arange(len(vertices)).reshape(-1, 3), gap=thickness,
                              room=min(room, MOST_NODES))
    except NoRoomError as error:
        if error.nodes > MOST_NODES:
            raise
        raise InputError(f'its grid has {error.nodes} nodes, and there is room for {room}; '
                         f'raise effects.contact.mesh_nodes by {error.nodes - room}') from None
