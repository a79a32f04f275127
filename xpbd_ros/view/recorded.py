"""
Logs in the browser: a time slider, speed, plots, and further logs beside the first.

The others are shown next to the first, with points coloured by their distance from the first.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import time
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.export.body import Body
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Command, Pose
from xpbd_ros.sim.simulation import Simulation
from xpbd_ros.view.controls import add_colour_menu, by_hand
from xpbd_ros.view.energy import energy_now, logged_energy
from xpbd_ros.view.stage import ramp, Stage, wrenches_of
from xpbd_ros.view.surface import GREY, Sheet, sheets_of

APART = 1.3
"""offset from one log to the next, over the size of the first"""
SPEEDS = ('0.1', '0.25', '0.5', '1', '2', '4', '10')
SAMPLES = 50
"""frames that the camera is fitted to"""
SAME = 1e-6
"""largest difference of times that count as equal [s]"""
MARGIN = 0.05
"""above and below plotted lines, over their range"""
LINES = ('#2f6db5', '#d9822b', '#3b8c5a', '#b5443c', '#7a5aa6', '#8a7a3c')
"""colours of plotted lines"""


@dataclass(frozen=True)
class Track:
    """A run, frame by frame, as arrays."""

    name: str
    frames: Sequence[int]
    """indices of the frames"""
    times: np.ndarray
    """[s], shape (frames,)"""
    triangles: Mapping[str, np.ndarray]
    """by cloth, shape (triangles, 3)"""
    positions: Mapping[str, np.ndarray]
    """by cloth [m], float32, shape (frames, particles, 3)"""
    pins: Sequence[Sequence[Body]]
    """by frame"""
    colliders: Sequence[Sequence[Body]]
    """by frame"""
    energy: Mapping[str, np.ndarray] = field(default_factory=dict)
    """parts of the energy [J], shape (frames,); empty if it is not known"""
    errors: Mapping[int, float] = field(default_factory=dict)
    """estimated errors, RMS over the particles [m], by frame"""

    @classmethod
    def read(cls, states, frames: Iterable) -> 'Track':
        """Return all frames of a log; ``frames`` iterates over its ``export.states.States``."""
        times, pins, colliders = np.zeros(len(states)), [], []
        positions = {cloth: np.empty((len(states), count, 3), np.float32)
                     for cloth, count in states.particles.items()}
        for k, state in enumerate(frames):
            times[k] = state.time_s
            for cloth, x in state.positions.items():
                positions[cloth][k] = x
            pins.append(state.pins)
            colliders.append(state.colliders)
        return cls(str(states.path), states.frames, times, states.triangles, positions, pins,
                   colliders, errors=states.errors())

    def with_energy(self, scene: Scene, commands: Mapping[int, Sequence[Command]],
                    numbers: Iterable[int]) -> 'Track':
        """Return a log with the energy by its scene and inputs; ``numbers`` counts its frames."""
        simulation = compile_scene(scene)
        if [len(cloth.slots) for cloth in simulation.cloths] != [
                x.shape[1] for x in self.positions.values()]:
            return self    # a log of several cloths that lacks some
        return replace(self, energy=logged_energy(
            simulation, commands, self.frames, self.times, list(self.positions.values()), numbers))

    @classmethod
    def stepped(cls, name: str, simulation: Simulation, commands: Mapping[int, Sequence],
                frames: Iterable[int]) -> 'Track':
        """Return a new run with commands by frame; ``frames`` counts its frames from 1 on."""
        states, energies = [simulation.frame()], [energy_now(simulation)]
        for index in frames:
            state = simulation.step(commands.get(index, ()))
            if not np.isfinite(state.x).all():
                break
            states.append(state)
            energies.append(energy_now(simulation))
        return cls(
            name, [state.index for state in states],
            np.array([1e-9 * state.time_ns for state in states]),
            {cloth.name: cloth.mesh.triangles for cloth in simulation.cloths},
            {cloth.name: np.array([state.x[cloth.particles] for state in states], np.float32)
             for cloth in simulation.cloths},
            [_bodies(state.pins) for state in states],
            [_bodies(state.colliders) for state in states],
            {part: np.array([each[part] for each in energies]) for part in energies[0]})

    def frame(self, index: int) -> list[np.ndarray]:
        """Return the positions of each cloth [m]."""
        return [x[index] for x in self.positions.values()]

    def sheets(self) -> list[Sheet]:
        """Return the cloths; an edge is as long as in the first frame."""
        return sheets_of(self.positions, self.triangles.values(), self.frame(0))

    def strains(self, sheets: Sequence[Sheet]) -> np.ndarray:
        """Return the largest strain of any edge in each frame, shape (frames,)."""
        return np.array([max((float(np.abs(sheet.strains(x)).max(initial=0.0))
                              for sheet, x in zip(sheets, self.frame(k))), default=0.0)
                         for k in range(len(self.times))])

    def total_energy(self) -> np.ndarray:
        """Return kinetic + potential + elastic energy in each frame [J], shape (frames,)."""
        return np.sum(list(self.energy.values()), axis=0)

    def latest_errors(self) -> np.ndarray:
        """Return the latest error estimate [m] up to each frame, shape (frames,); NaN before."""
        known = np.array(sorted(self.errors))
        place = np.searchsorted(known, self.frames, side='right') - 1
        values = np.array([self.errors[frame] for frame in known] + [np.nan])
        return values[place]    # -1, the last one, where there is none yet


def _bodies(states: Mapping[str, Any]) -> list[Body]:
    """Return the pins or colliders of a frame."""
    return [Body(name, tuple(state.pose.position), tuple(state.pose.orientation),
                 tuple(state.force), tuple(state.torque)) for name, state in states.items()]


def changes(values: np.ndarray) -> np.ndarray:
    """Return the changes since the first value that is known."""
    known = values[np.isfinite(values)]
    return values - known[0] if len(known) else values


class Beside:
    """
    A further run next to the first, with points coloured by the distance from the first.

    Parameters
    ----------
    server : viser server
    number : its place, from 1 on
    track, first : both runs
    size : size of the first [m]

    Raises
    ------
    InputError : the runs are of different cloths

    """

    def __init__(self, server, number: int, track: Track, first: Track, size: float):
        counts = [{cloth: x.shape[1] for cloth, x in each.positions.items()}
                  for each in (track, first)]
        if list(counts[0].items()) != list(counts[1].items()):
            raise InputError(f'--beside: {track.name}: has other cloths than {first.name}')
        self.track = track
        self.offset = np.array([number * APART * size, 0.0, 0.0], np.float32)
        at = np.searchsorted(track.times, first.times + SAME, side='right') - 1
        self._index = np.where(first.times <= track.times[-1] + SAME, np.maximum(at, 0), -1)
        self.distances = [
            np.concatenate([np.linalg.norm(a - b, axis=1) for a, b in zip(
                first.frame(k), track.frame(index))]) if index >= 0 else np.empty(0, np.float32)
            for k, index in enumerate(self._index)]
        """from the first run [m], by its frames; empty after the end of this one"""
        self.farthest = max(float(each.max(initial=0.0)) for each in self.distances) or 1.0
        self._meshes = [server.scene.add_mesh_simple(
            f'/beside/{number}/{cloth}', x[0] + self.offset, track.triangles[cloth], side='double',
            color=tuple(map(int, GREY))) for cloth, x in track.positions.items()]
        self._points = server.scene.add_point_cloud(
            f'/beside/{number}/points', np.concatenate(track.frame(0)) + self.offset,
            ramp(np.zeros(len(self.distances[0]))), precision='float32',
            point_size=0.012 * size, point_shape='circle')

    def index(self, index: int) -> int | None:
        """Return the frame at the time of a frame of the first run; None after its end."""
        return int(self._index[index]) if self._index[index] >= 0 else None

    def show(self, index: int, farthest: float) -> None:
        """Show the frame at the time of a frame of the first run; red is ``farthest`` [m]."""
        at = self.index(index)
        if at is None:
            return
        places = [x + self.offset for x in self.track.frame(at)]
        for mesh, x in zip(self._meshes, places):
            mesh.vertices = x
        self._points.points = np.concatenate(places)
        self._points.colors = ramp(self.distances[index] / farthest)


class RecordedView:
    """
    The page of one or more runs.

    Parameters
    ----------
    server : viser server
    tracks : runs of the same cloths; the first is the one that the others are compared with
    entries : colliders of the scene, which have shapes
    names : texts below the cloths, by run; empty for none

    """

    def __init__(self, server, tracks: Sequence[Track], entries: Mapping[str, Any],
                 names: Sequence[str] = ()):
        self._server, self._track, self._entries = server, tracks[0], entries
        sheets = self._track.sheets()
        size = float(np.ptp(np.concatenate(self._track.frame(0)), axis=0).max()) or 1.0
        self._beside = [Beside(server, k, track, tracks[0], size)
                        for k, track in enumerate(tracks[1:], 1)]
        self._farthest = max((each.farthest for each in self._beside), default=1.0)
        self.stage = Stage(server, sheets, self._track.frame(0), self._seen())
        server.on_client_connect(self.stage.aim)
        for k, name in enumerate(names):
            x = np.concatenate(self._track.frame(0))
            foot = np.array([x[:, 0].mean(), x[:, 1].min(),
                             self._seen()[:, 2].min() - 0.1 * size])
            server.scene.add_label(f'/names/{k}', name, anchor='top-center', position=tuple(
                foot + (self._beside[k - 1].offset if k else 0.0)))
        self._labels = [name.split('\n')[0] for name in names] or [
            'first', *(f'run {k}' for k in range(2, len(tracks) + 1))]
        self.playing = True
        self._index = 0
        gui = server.gui
        self._figures = gui.add_markdown('')
        self._slider = gui.add_slider('Frame', 0, max(1, len(self._track.times) - 1), 1, 0)
        self._slider.on_update(self._seek)
        self._play = gui.add_button('Pause')
        self._play.on_click(lambda _: self._toggle())
        self._speed = gui.add_dropdown('Speed', SPEEDS, initial_value='1')
        self._loop = gui.add_checkbox('Loop', True)
        add_colour_menu(gui, self.stage, ('none', 'strain'))
        self._plot()
        self.show(0)

    def _seen(self) -> np.ndarray:
        """Return the points that all runs reach, as seen by the camera."""
        def corners(track: Track, offset) -> list[np.ndarray]:
            step = max(1, len(track.times) // SAMPLES)
            found = []
            for x in track.positions.values():
                places = x[::step].reshape(-1, 3)
                places = places[np.isfinite(places).all(axis=1)]
                found += [places.min(axis=0) + offset, places.max(axis=0) + offset]
            return found
        return np.array([*corners(self._track, 0.0), *(
            place for each in self._beside for place in corners(each.track, each.offset))])

    def _plot(self) -> None:
        """Plot distances to the first run, forces, energies, strains and errors."""
        labels = self._labels
        if self._beside:
            self._chart(f'distance to the {self._labels[0]} [mm]', {
                label: np.array([1e3 * d.max() if len(d) else np.nan for d in each.distances])
                for label, each in zip(labels[1:], self._beside)})
        bodies = [[*pins, *colliders] for pins, colliders in zip(self._track.pins,
                                                                 self._track.colliders)]
        forces = {body.name: np.zeros(len(bodies)) for frame in bodies for body in frame}
        for k, frame in enumerate(bodies):
            for body in frame:
                forces[body.name][k] = np.linalg.norm(body.force)
        self._chart('force of the cloth', {f'{name} [N]': values
                                           for name, values in forces.items() if values.any()})
        energies = self._lines(
            lambda track: changes(track.total_energy()) if track.energy else None)
        if not self._beside and energies:
            energies = {'total': energies[labels[0]], **{
                part: changes(values) for part, values in self._track.energy.items()}}
        self._chart('energy: kinetic + potential + elastic, change since the start [J]', energies)
        self._chart('largest strain [%]',
                    self._lines(lambda track: 100.0 * track.strains(track.sheets())))
        self._chart('estimated error of a frame, RMS [mm]', self._lines(
            lambda track: 1e3 * track.latest_errors() if track.errors else None))

    def _lines(self, values_of: Callable[[Track], np.ndarray | None]) -> dict[str, np.ndarray]:
        """Return lines of all runs by label, at the times of the first; None has no line."""
        found = {}
        for k, label in enumerate(self._labels):
            values = values_of(self._beside[k - 1].track if k else self._track)
            if values is not None:
                found[label] = values if k == 0 else np.array([
                    np.nan if at is None else values[at]
                    for at in map(self._beside[k - 1].index, range(len(self._track.times)))])
        return found

    def _chart(self, title: str, lines: Mapping[str, np.ndarray]) -> None:
        """Add a plot of lines against the time, unless there are none."""
        lines = {name: np.asarray(values, float) for name, values in lines.items()}
        known = np.concatenate([values[np.isfinite(values)] for values in lines.values()] or [[]])
        if not len(known):
            return
        low, high = min(0.0, known.min()), max(0.0, known.max())
        margin = MARGIN * (high - low) or 1.0
        self._server.gui.add_markdown(title)
        self._server.gui.add_uplot(
            (self._track.times, *lines.values()),
            ({'label': 'time [s]'}, *({'label': name, 'stroke': LINES[k % len(LINES)],
                                       'width': 1.5} for k, name in enumerate(lines))),
            aspect=1.6, scales={'x': {'time': False},    # NaN would hide the range
                                'y': {'range': (low - margin * (low < 0.0), high + margin)}})

    def show(self, index: int) -> None:
        """Show a frame."""
        self._index, track = index, self._track
        with self._server.atomic():
            self.stage.show(track.frame(index))
            self.stage.show_wrenches(wrenches_of(track.pins[index]),
                                     wrenches_of(track.colliders[index]))
            self._show_bodies(track.colliders[index], '', 0.0)
            for k, each in enumerate(self._beside, 1):
                each.show(index, self._farthest)
                at = each.index(index)
                if at is not None:
                    self._show_bodies(each.track.colliders[at], f'beside_{k}/', each.offset)
        rows = [f'**{track.times[index]:.2f} s**, frame {track.frames[index]} of '
                f'{track.frames[-1]}']
        rows += [f'distance {1e3 * each.distances[index].max():.3g} mm at most: {label}'
                 for label, each in zip(self._labels[1:], self._beside)
                 if len(each.distances[index])]
        self._figures.content = '  \n'.join(rows)

    def _show_bodies(self, bodies: Sequence[Body], prefix: str, offset) -> None:
        """Show colliders; planes only for the first run, as they reach everywhere."""
        for body in bodies:
            entry = self._entries.get(body.name)
            if entry is not None and not (prefix and entry.shape == 'plane'):
                x, y, z = map(float, np.add(body.position, offset))
                self.stage.show_body(prefix + body.name, entry, Pose((x, y, z), body.orientation))

    def _seek(self, event) -> None:
        if by_hand(event):    # and not by the playback
            self.show(min(int(self._slider.value), len(self._track.times) - 1))

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
        self.stage.aim_all(panel=False)
        serializer = self._server.get_scene_serializer()
        times = self._track.times
        for now_s in np.arange(times[0], times[-1] + 1e-9, 1.0 / rate):
            self.show(int(np.searchsorted(times, now_s + 1e-9, side='right')) - 1)
            serializer.insert_sleep(1.0 / rate)
        return serializer.as_html()
