"""One OBJ or PLY file for each frame and cloth, numbered by frame, as renderers import them."""

from collections.abc import Callable, Iterable
from pathlib import Path

from xpbd_ros.errors import InputError
from xpbd_ros.export.states import State, States


def write(folder: Path, states: States, frames: Callable[[], Iterable[State]], *,
          suffix: str) -> list[Path]:
    """Write the files, and return their paths."""
    try:
        import meshio
    except ImportError as error:
        raise InputError(f'--format {suffix} needs meshio ({error}); pip install '
                         "'xpbd_ros[export]' (or apt install python3-meshio)") from None
    digits, found = max(4, len(str(states.frames[-1]))), []
    for state in frames():
        for cloth, positions in state.positions.items():
            path = folder / f'{cloth}_{state.frame:0{digits}d}.{suffix}'
            meshio.write_points_cells(path, positions, [('triangle', states.triangles[cloth])])
            found.append(path)
    return found
