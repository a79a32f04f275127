"""
Read meshes from files: OBJ here, other formats with meshio (STL, PLY, OFF, VTK, Gmsh's MSH …).

Of an OBJ file only the lines ``v`` and ``f`` are read. meshio and trimesh are not used for OBJ
because they split or reorder the vertices of files with texture seams or several materials.
"""

from contextlib import redirect_stderr, redirect_stdout
import io
from pathlib import Path
import warnings

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.polygons import triangulated

USED = ('triangle', 'quad', 'polygon', 'tetra')
IGNORED = ('vertex', 'line')
HEADERS = {'.ply': (b'ply', lambda line: line == b'end_header'),
           '.off': (b'OFF', lambda line: line[:1] not in (b'', b'#'))}
"""first line of a format, and whether a later one ends its header"""


def read_mesh_file(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read a mesh file.

    Returns
    -------
    vertices : positions in the file's unit, shape (vertices, 3)
    triangles : indices, shape (triangles, 3); polygons are split
    tetrahedra : indices, shape (tetrahedra, 4)

    """
    _require_file(path)
    try:
        return _read_obj(path) if path.suffix.lower() == '.obj' else _read_with_meshio(path)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from error


def _require_file(path: Path) -> None:
    """Raise InputError unless a path is that of a file."""
    try:
        if path.is_dir():
            raise InputError(f'{path} is a folder; name a file in it')
        if not path.is_file():
            raise InputError(f'no such file: {path}; restore it, or correct the path')
    except OSError as error:    # such as a name that is too long
        raise InputError(f'{path}: {error.strerror}') from None


def _read_obj(path: Path):
    vertices, polygons, lines = [], [], []
    last, named_in = -1, 0    # the vertex of the highest number, and the line that names it
    text = path.read_text(encoding='utf-8', errors='replace').replace('\\\n', ' ')
    for number, line in enumerate(text.splitlines(), 1):
        key, *words = line.partition('#')[0].split() or ['']
        try:
            if key == 'v':
                x, y, z = map(float, words[:3])
                vertices.append((x, y, z))
            elif key == 'f':
                corners = [int(word.partition('/')[0]) for word in words]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError
                corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                if min(corners) < 0:
                    raise ValueError
                polygons.append(corners)
                lines.append(number)
                if max(corners) > last:
                    last, named_in = max(corners), number
        except ValueError:
            raise InputError(f'{path}: line {number}: cannot be read as OBJ '
                             f'(got {line.strip()[:40]!r})') from None
    if last >= len(vertices):
        raise InputError(f'{path}: line {named_in}: vertex {last + 1} does not exist (there are '
                         f'{len(vertices)})')
    places = np.array(vertices, float).reshape(-1, 3)
    return (places, triangulated(places, polygons, lambda k: f'{path}: line {lines[k]}'),
            np.zeros((0, 4), np.int64))


def _require_header(path: Path) -> None:
    """Raise InputError if a header is cut off: meshio would never stop at the end of the file."""
    first, is_last = HEADERS.get(path.suffix.lower(), (None, None))
    if is_last is not None:
        with path.open('rb') as file:
            if file.readline().strip() == first and not any(is_last(n.strip()) for n in file):
                raise InputError(f'{path}: cannot be read as a mesh (its header is cut off)')


def _read_with_meshio(path: Path):
    try:
        import meshio
    except ImportError as error:
        raise InputError(f'{path}: only .obj files can be read without meshio ({error}); pip '
                         'install meshio (or apt install python3-meshio)') from None
    _require_header(path)
    said = io.StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(said), redirect_stderr(said):
            warnings.simplefilter('ignore')
            found = meshio.read(path)
    except OSError:
        raise
    except (Exception, SystemExit) as error:    # meshio exits on files that it cannot read
        reason = str(error) if not isinstance(error, SystemExit) else said.getvalue()
        reason = ' '.join(reason.replace('Error:', '').split())
        raise InputError(f'{path}: cannot be read as a mesh ({reason})') from None
    points = np.asarray(found.points, float)
    if points.ndim != 2:    # meshio's for a file without any
        raise InputError(f'{path}: cannot be read as a mesh (it has no points)')
    vertices = np.zeros((len(points), 3))
    vertices[:, :points.shape[1]] = points
    polygons: list[list[int]] = []
    tetrahedra = []
    for block in found.cells:
        if block.type == 'tetra':
            tetrahedra.append(np.asarray(block.data, np.int64))
        elif block.type in USED:
            polygons += [[int(c) for c in corners] for corners in block.data]
        elif block.type not in IGNORED:
            raise InputError(f"{path}: holds cells of type '{block.type}'; only triangles, "
                             'polygons and tetrahedra can be simulated, so convert it')
    return (vertices, triangulated(vertices, polygons, lambda k: f'{path}: polygon {k}'),
            np.concatenate(tetrahedra) if tetrahedra else np.zeros((0, 4), np.int64))


def read_table(file: str) -> np.ndarray:
    """Return a table of numbers from a .npy file, or from text with commas or blanks between."""
    path = Path(file)
    _require_file(path)
    try:
        if path.suffix.lower() == '.npy':
            return np.load(path, allow_pickle=False)
        text = path.read_text(encoding='utf-8').replace(',', ' ')
        return np.array([line.split() for line in text.splitlines() if line.strip()], float)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from error
    except ValueError as error:
        raise InputError(f'{path}: cannot be read as rows of numbers ({error})') from None
