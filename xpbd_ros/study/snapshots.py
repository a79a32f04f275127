"""Pictures of a run: what a frame of a simulation looks like, at a few instants."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from xpbd_ros.sim.simulation import Frame, Simulation
from xpbd_ros.study.picture import Body, draw, Instant, Surface
from xpbd_ros.study.picture.content import SHAPES

COLOURS = ('#2a78b5', '#c1803a', '#4a9a62', '#8a5fb0')
"""of the cloths, in turn"""
SHARES = (0.1, 0.4, 1.0)
"""of a run, when it is looked at"""
LIMIT = 60_000
"""[bytes]"""


def size_of(entry) -> tuple[float, ...]:
    """Return a collider's size as the picture wants it."""
    shape = getattr(entry, entry.shape)
    return {'plane': (), 'sphere': (getattr(shape, 'radius', 0),)}.get(
        entry.shape, getattr(shape, 'size', None)
        or (getattr(shape, 'radius', 0), getattr(shape, 'length', 0)))


def instant(simulation: Simulation, frame: Frame) -> Instant:
    """Return what a picture of a frame shows."""
    return instant_of(f'{1e-9 * frame.time_ns:.2f} s', (
        (frame.x[cloth.particles], cloth.mesh.triangles) for cloth in simulation.cloths), (
        (state.entry, state.pose.position, state.pose.orientation)
        for state in frame.colliders.values()))


def instant_of(title: str, cloths: Iterable[tuple[np.ndarray, np.ndarray]],
               colliders: Iterable[tuple]) -> Instant:
    """
    Return a picture's content; colliders that are meshes or ground are left out.

    Parameters
    ----------
    title : of the picture
    cloths : positions [m], shape (particles, 3), and triangles, shape (triangles, 3), of each
    colliders : entry in the scene, position and orientation of each

    """
    surfaces = [Surface(x, triangles, COLOURS[k % len(COLOURS)])
                for k, (x, triangles) in enumerate(cloths) if len(triangles)]
    bodies = [Body(entry.shape, size_of(entry), position, orientation)
              for entry, position, orientation in colliders if entry.shape in SHAPES]
    return Instant(title, surfaces, bodies)


class Shots:
    """Looks at a run a few times, and draws what it has seen."""

    def __init__(self, simulation: Simulation, frames: int):
        self._simulation = simulation
        self._when = {max(1, round(share * frames)) for share in SHARES}
        self._seen: list[Instant] = []

    def look(self, frame: Frame) -> None:
        """Keep a frame if it is its turn."""
        if frame.index in self._when:
            self._seen.append(instant(self._simulation, frame))

    def draw(self, file: Path) -> Path:
        """Write a PNG; return its whole path."""
        draw(self._seen, file, width_px=1000, limit=LIMIT)
        return file.absolute()
