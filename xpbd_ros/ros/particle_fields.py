"""Further fields of ``~/particles``, for the parameter ``particle_fields``."""

from collections.abc import Sequence

import numpy as np
from sensor_msgs.msg import PointField

from xpbd_ros.errors import InputError
from xpbd_ros.scene.read import unknown
from xpbd_ros.sim.effect import Cloth
from xpbd_ros.sim.measure import normals, strains
from xpbd_ros.sim.simulation import Frame

FIELDS = {'velocity': 'vx vy vz', 'normal': 'normal_x normal_y normal_z', 'strain': 'strain',
          'pinned': 'pinned', 'id': 'id'}
"""names in the cloud, by the words of the parameter"""
KINDS = {'pinned': PointField.UINT8, 'id': PointField.UINT32}
"""types other than float32, each in four bytes"""


def words_of(text: str) -> tuple[str, ...]:
    """Return the words of the parameter, each once; raise InputError for an unknown one."""
    words = text.replace(',', ' ').split()
    for word in words:
        if word not in FIELDS:
            raise InputError(f"particle_fields: {unknown(word, FIELDS, 'field')}")
    return tuple(dict.fromkeys(words))


def names(words: Sequence[str]) -> str:
    """Return the names of all fields of a cloud, x y z included."""
    return ' '.join(['x y z', *(FIELDS[word] for word in words)])


def table(words: Sequence[str], cloth: Cloth, frame: Frame) -> np.ndarray:
    """Return a cloth's points in float32; integers as their bits; shape (particles, fields)."""
    these = cloth.particles
    x = frame.x[these]
    columns = [x.astype(np.float32)]
    for word in words:
        if word == 'velocity':
            columns.append(frame.v[these].astype(np.float32))
        elif word == 'normal':
            columns.append(normals(cloth, x).astype(np.float32))
        elif word == 'strain':
            columns.append(strains(cloth, x).astype(np.float32)[:, None])
        else:
            value = np.arange(len(frame.x)) if word == 'id' else np.zeros(len(frame.x))
            for pin in frame.pins.values() if word == 'pinned' else ():
                value[pin.particles] = 1
            first = these.start if word == 'id' else 0
            columns.append((value[these] - first).astype('<u4').view(np.float32)[:, None])
    return np.hstack(columns)
