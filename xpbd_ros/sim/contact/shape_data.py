"""Distance fields and heights of a scene's colliders."""

from collections.abc import Mapping

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.contact.collider_entries import Body, Entry, table
from xpbd_ros.sim.contact.distance_field import distance_field, Field


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
