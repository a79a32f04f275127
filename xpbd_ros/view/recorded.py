"""
A log in the browser: a time slider, speed, plots of forces, and a second log beside it.

The second log is shown next to the first, with points coloured by their distance from the first.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import time
from types import SimpleNamespace

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.export.states import Body, States
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.mesh import edges
from xpbd_ros.view.stage import Sheet, Stage

APART = 1.3
"""offset of the second log, over the size of the scene"""
NEAR, FAR = np.array([235, 235, 235]), np.array([200, 40, 30])
"""colours of particles without distance, and at the largest"""
SPEEDS = ('0.1', '0.25', '0.5', '1', '2', '4', '10')


@dataclass(frozen=True)
class Track:
    """A log, read into arrays."""

    states: States
    times: np.ndarray
    """[s], shape (frames,)"""
    positions: dict[str, np.ndarray]
    """by cloth [m], float32, shape (frames, particles, 3)"""
    pins: list[list[Body]]
    colliders: list[list[Body]]

    @classmethod
    def read(cls, states: States, frames: Iterable) -> 'Track':
        """Return all frames of a log; ``frames`` iterates over its states."""
        times, pins, colliders = np.zeros(len(states)), [], []
        positions = {cloth: np.empty((len(states), count, 3), np.float32)
                     for cloth, count in states.particles.items()}
        for k, state in enumerate(frames):
            times[k] = state.time_s
            for cloth, x in state.positions.items():
                positions[cloth][k] = x
            pins.append(state.pins)
            colliders.append(state.colliders)
        return cls(states, times, positions, pins, colliders)

    def frame(self, index: int) -> list[np.ndarray]:
        """Return the positions of each cloth [m]."""
        return [x[index] for x in self.positions.values()]

    def sheets(self) -> list[Sheet]:
        """Return the cloths; an edge is as long as in the first frame."""
        found = []
        for cloth, x in self.positions.items():
            triangles = self.states.triangles[cloth]
            ends = edges(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
            length = np.linalg.norm(x[0][ends[:, 1]] - x[0][ends[:, 0]], axis=1)
            found.append(Sheet(cloth, triangles, ends, np.maximum(length, 1e-9)))
        return found


class RecordedView:
    """
    The page of a log.

    Parameters
    ----------
    server : viser server
    track : the log
    scene : of the log, whose colliders have shapes
    beside : a second log of the same cloths; None for none

    """

    def __init__(self, server, track: Track, scene: Scene, beside: Track | None = None):
        self._server, self._track, self._beside = server, track, beside
        self._entries = scene.sections.get('colliders', {})
        self.stage = Stage(server, track.sheets(), track.frame(0))
        server.on_client_connect(self.stage.aim)
        self.playing = True
        self._index = 0
        if beside is not None:
            self._add_beside(beside)
        gui = server.gui
        self._figures = gui.add_markdown('')
        self._slider = gui.add_slider('Frame', 0, max(1, len(track.times) - 1), 1, 0)
        self._slider.on_update(lambda event: self._seek(event))
        self._play = gui.add_button('Pause')
        self._play.on_click(lambda _: self._toggle())
        self._speed = gui.add_dropdown('Speed', SPEEDS, initial_value='1')
        self._loop = gui.add_checkbox('Loop', True)
        strain = gui.add_checkbox('Strain', False, hint='relative to the first frame')
        strain.on_update(lambda _: setattr(self.stage, 'strain', strain.value))
        self._plot()
        self.show(0)

    def _add_beside(self, beside: Track) -> None:
        if list(beside.states.particles.items()) != list(self._track.states.particles.items()):
            raise InputError(f'--beside: {beside.states.path}: has other cloths than '
                             f'{self._track.states.path}')
        frames = min(len(beside.times), len(self._track.times))
        self._distances = [
            np.concatenate([np.linalg.norm(a - b, axis=1) for a, b in zip(
                self._track.frame(k), beside.frame(k))]) for k in range(frames)]
        self._farthest = max(float(each.max()) for each in self._distances) or 1.0
        self._offset = np.array([APART * self.stage.size, 0.0, 0.0], np.float32)
        self._points = self._server.scene.add_point_cloud(
            '/beside', self._beside_points(0), self._beside_colours(0), precision='float32',
            point_size=0.012 * self.stage.size, point_shape='circle')

    def _beside_points(self, index: int) -> np.ndarray:
        assert self._beside is not None
        return np.concatenate(self._beside.frame(index)) + self._offset

    def _beside_colours(self, index: int) -> np.ndarray:
        share = self._distances[index][:, None] / self._farthest
        return (NEAR + share * (FAR - NEAR)).astype(np.uint8)

    def _plot(self) -> None:
        """Plot the forces on the pins and colliders, and the distance to the second log."""
        names = list(dict.fromkeys(body.name for frame in (*self._track.pins,
                                                           *self._track.colliders)
                                   for body in frame))
        forces = {name: np.zeros(len(self._track.times)) for name in names}
        for k, bodies in enumerate(zip(self._track.pins, self._track.colliders)):
            for body in (*bodies[0], *bodies[1]):
                forces[body.name][k] = np.linalg.norm(body.force)
        lines = {f'{name} [N]': values for name, values in forces.items() if values.any()}
        if self._beside is not None:
            apart = np.full(len(self._track.times), np.nan)
            apart[:len(self._distances)] = [1e3 * each.max() for each in self._distances]
            self._server.gui.add_markdown('distance of the logs [mm]')
            self._chart({'largest': apart})
        if lines:
            self._server.gui.add_markdown('force of the cloth')
            self._chart(lines)

    def _chart(self, lines: dict[str, np.ndarray]) -> None:
        colours = ('#2f6db5', '#d9822b', '#3b8c5a', '#b5443c', '#7a5aa6', '#8a7a3c')
        self._server.gui.add_uplot(
            (self._track.times, *lines.values()),
            ({'label': 'time [s]'}, *({'label': name, 'stroke': colours[k % len(colours)],
                                       'width': 1.5} for k, name in enumerate(lines))),
            aspect=1.6, scales={'x': {'time': False}})

    def show(self, index: int) -> None:
        """Show a frame."""
        self._index, track = index, self._track
        with self._server.atomic():
            self.stage.show(track.frame(index))
            self.stage.show_forces({body.name: (body.position, body.force)
                                    for body in (*track.pins[index], *track.colliders[index])
                                    if any(body.force)})
            for body in track.colliders[index]:
                if body.name in self._entries:
                    self.stage.show_body(body.name, SimpleNamespace(
                        entry=self._entries[body.name],
                        pose=Pose(body.position, body.orientation)))
            if self._beside is not None and index < len(self._distances):
                self._points.points = self._beside_points(index)
                self._points.colors = self._beside_colours(index)
        rows = [f'**{track.times[index]:.2f} s**, frame {track.states.frames[index]} of '
                f'{track.states.frames[-1]}']
        if self._beside is not None and index < len(self._distances):
            rows.append(f'distance {1e3 * self._distances[index].max():.3g} mm at most')
        self._figures.content = '  \n'.join(rows)

    def _seek(self, event) -> None:
        if event.client is not None:    # the user's hand, not the playback
            self.show(int(self._slider.value))

    def _toggle(self) -> None:
        self.playing = not self.playing
        self._play.label = 'Pause' if self.playing else 'Play'

    def run(self, stopped: Callable[[], bool], *, period: float = 1.0 / 30.0) -> None:
        """Play until ``stopped()``; ``period`` is that of the pictures [s]."""
        times, last = self._track.times, time.monotonic()
        now_s, shown = 0.0, 0
        while not stopped():
            time.sleep(period)
            passed, last = time.monotonic() - last, time.monotonic()
            if self._index != shown:    # the slider was moved
                now_s = times[self._index]
            if self.playing:
                now_s += passed * float(self._speed.value)
                if now_s > times[-1]:
                    now_s = times[0] if self._loop.value else times[-1]
                index = int(np.searchsorted(times, now_s, side='right')) - 1
                if index != self._index:
                    self.show(index)
                    self._slider.value = index
            shown = self._index

    def as_html(self, *, rate: float = 30.0) -> str:
        """Return a page that plays without a server, with ``rate`` pictures a second."""
        serializer = self._server.get_scene_serializer()
        times = self._track.times
        for now_s in np.arange(times[0], times[-1] + 1e-9, 1.0 / rate):
            self.show(int(np.searchsorted(times, now_s + 1e-9, side='right')) - 1)
            serializer.insert_sleep(1.0 / rate)
        return serializer.as_html()
