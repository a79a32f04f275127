"""The surface of a cloth: in one colour, or in bands of colours for values of its triangles."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

GREY = np.array([188, 191, 195])
"""colour of the value 0"""
SLACK, TAUT = np.array([48, 111, 224]), np.array([212, 52, 40])
"""colours of -1 and of 1"""
BANDS = 4
"""number of colours on either side of GREY"""

SIDES = [[0, 1], [1, 2], [2, 0]]
"""corners of a triangle"""
RIGHT = 1e-3
"""how far a² + b² of a right angle may differ from c², over c²"""


@dataclass(frozen=True)
class Sheet:
    """
    A cloth: its triangles and edges.

    On grids the edges are those along warp and weft, as in ``measure.largest_strain``.
    """

    name: str
    triangles: np.ndarray
    """shape (triangles, 3)"""
    edges: np.ndarray
    """shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""
    sides: np.ndarray
    """edges of each triangle, shape (triangles, 3), or (triangles, 2) on a grid"""

    def strains(self, x: np.ndarray) -> np.ndarray:
        """Return l / L - 1 of each edge at positions x [m], with rest length L."""
        along = x[self.edges[:, 1]] - x[self.edges[:, 0]]
        return np.sqrt(np.einsum('ij,ij->i', along, along)) / self.rest_length - 1.0

    def strains_of_triangles(self, x: np.ndarray) -> np.ndarray:
        """Return the strain of each triangle's most strained edge, with its sign."""
        strains = self.strains(x)[self.sides]
        most = np.abs(strains).argmax(axis=1)[:, None]
        return np.take_along_axis(strains, most, axis=1)[:, 0]


def sheets_of(names: Iterable[str], triangles: Iterable[np.ndarray],
              positions: Iterable[np.ndarray]) -> list[Sheet]:
    """
    Return cloths whose edges are as long as at given positions.

    Parameters
    ----------
    names : by cloth
    triangles : by cloth, shape (triangles, 3)
    positions : by cloth [m], shape (particles, 3)

    """
    found = []
    for name, corners, x in zip(names, triangles, positions):
        pairs = without_diagonals(np.sort(corners[:, SIDES], axis=2), x)
        ends, sides = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
        length = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
        found.append(Sheet(name, corners, ends, np.maximum(length, 1e-9),
                           sides.reshape(pairs.shape[:2])))
    return found


def without_diagonals(pairs: np.ndarray, x: np.ndarray) -> np.ndarray:
    """
    Return the sides of triangles without the diagonals of a grid.

    A mesh whose triangles are all right-angled is taken for a grid.

    Parameters
    ----------
    pairs : ends of the sides, shape (triangles, 3, 2)
    x : positions at rest [m], shape (particles, 3)

    Returns
    -------
    shape (triangles, 2, 2) for a grid, else all of them

    """
    squares = np.square(x[pairs[..., 1]] - x[pairs[..., 0]], dtype=float).sum(axis=2)
    order = squares.argsort(axis=1)
    short, middle, longest = np.take_along_axis(squares, order, axis=1).T
    if (abs(longest - short - middle) > RIGHT * longest).any():
        return pairs
    return np.take_along_axis(pairs, np.sort(order[:, :2], axis=1)[..., None], axis=1)


class Surface:
    """
    The surface of one cloth.

    A mesh of viser has one colour. So a coloured surface is made of one mesh for each band of
    values, which has the triangles of the band.

    Parameters
    ----------
    server : viser server
    sheet : cloth
    x : positions [m], shape (particles, 3)
    colour : sRGB bytes of the surface without values

    """

    def __init__(self, server, sheet: Sheet, x: np.ndarray, colour: tuple[int, int, int]):
        self._scene, self._sheet = server.scene, sheet
        self._plain = self._mesh('plain', x, sheet.triangles, colour)
        self._bands: dict = {}
        self._acts: list[Callable] = []

    def _mesh(self, name: str, x: np.ndarray, triangles: np.ndarray, colour):
        return self._scene.add_mesh_simple(
            f'/cloths/{self._sheet.name}/{name}', x.astype(np.float32), triangles, side='double',
            color=tuple(map(int, colour)))

    def on_click(self, act: Callable) -> None:
        """Call ``act(event)`` when the surface is clicked."""
        self._acts.append(act)
        for mesh in (self._plain, *self._bands.values()):
            mesh.on_click(act)

    def show(self, x: np.ndarray, values: np.ndarray | None = None) -> None:
        """
        Show the surface.

        Parameters
        ----------
        x : positions [m], shape (particles, 3)
        values : of the triangles, from -1 to 1, shape (triangles,); None for one colour

        """
        x = x.astype(np.float32)
        bands = {} if values is None else parts_of(self._sheet.triangles, bands_of(values), len(x))
        show(self._plain, values is None)
        if values is None:
            self._plain.vertices = x
        for band, mesh in self._bands.items():
            show(mesh, band in bands)
        for band, (particles, triangles) in bands.items():
            if band in self._bands:
                self._bands[band].vertices = x[particles]
                self._bands[band].faces = triangles
            else:
                mesh = self._bands[band] = self._mesh(
                    f'band_{band + BANDS}', x[particles], triangles, colour_of(band))
                for act in self._acts:
                    mesh.on_click(act)


def show(mesh, visible: bool) -> None:
    """Show or hide a mesh, with a message only if that changes."""
    if mesh.visible != visible:
        mesh.visible = visible


def bands_of(values: np.ndarray) -> np.ndarray:
    """Return the bands, from -BANDS to BANDS, of values from -1 to 1; those beyond are clipped."""
    return np.rint(BANDS * np.clip(np.nan_to_num(values), -1.0, 1.0)).astype(np.int64)


def colour_of(band: int) -> np.ndarray:
    """Return the sRGB bytes of a band, shape (3,)."""
    share = abs(band) / BANDS
    return np.rint(GREY + share * ((TAUT if band > 0 else SLACK) - GREY)).astype(np.uint8)


def parts_of(triangles: np.ndarray, bands: np.ndarray, count: int
             ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """
    Return the parts of a mesh by their band.

    Parameters
    ----------
    triangles : shape (triangles, 3)
    bands : of the triangles, shape (triangles,)
    count : number of particles

    Returns
    -------
    particles of each part, shape (its particles,), and its triangles, whose corners are indices of
    these, shape (its triangles, 3), uint32

    """
    found, place = {}, np.empty(count, np.uint32)
    for band in range(-BANDS, BANDS + 1):
        corners = triangles[bands == band]
        if len(corners):
            used = np.zeros(count, bool)
            used[corners] = True
            particles = np.flatnonzero(used)
            place[particles] = np.arange(len(particles))
            found[band] = particles, place[corners]
    return found
