"""
One .npz file for all frames, written frame by frame; ``numpy.load`` reads it.

Its arrays are ``frame`` and ``time_s`` (frames,), and for each cloth NAME ``NAME_positions``
(frames, particles, 3) in m and ``NAME_triangles`` (triangles, 3).
"""

from collections.abc import Callable, Iterable
from pathlib import Path
import zipfile

import numpy as np

from xpbd_ros.export.states import State, States


def write(folder: Path, states: States, frames: Callable[[], Iterable[State]]) -> list[Path]:
    """Write the file, and return its path."""
    path, times = folder / 'states.npz', np.zeros(len(states))
    with zipfile.ZipFile(path, 'x', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for cloth, particles in states.particles.items():
            with archive.open(f'{cloth}_positions.npy', 'w', force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, {
                    'descr': '<f4', 'fortran_order': False, 'shape': (len(states), particles, 3)})
                for k, state in enumerate(frames()):
                    times[k] = state.time_s
                    file.write(state.positions[cloth].tobytes())
        for name, array in (('frame', np.array(states.frames)), ('time_s', times),
                            *((f'{cloth}_triangles', triangles)
                              for cloth, triangles in states.triangles.items())):
            with archive.open(f'{name}.npy', 'w') as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    return [path]
