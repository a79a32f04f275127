"""
A running scene in the browser: it steps in real time, and the page drags pins and colliders.

All that the page does becomes commands, which act between two frames and are recorded as those of
the node are, so that a recorded session repeats bit for bit. Drawing only reads frames; the state
does not depend on whether, or how fast, a browser follows.
"""

from collections import deque
from collections.abc import Callable, Mapping
import time
from typing import Any

import numpy as np
from numpy.linalg import norm

from xpbd_ros.errors import InputError
from xpbd_ros.ros.error_monitor import ErrorMonitor
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.model import live_keys, Scene
from xpbd_ros.sim.commands import Command, Grasp, Pose, Release, ReleaseAll, Reset
from xpbd_ros.sim.measure import (
    contact_forces,
    has_tensions,
    largest_strain,
    tensions,
    touching,
)
from xpbd_ros.sim.simulation import Frame, Simulation
from xpbd_ros.view.controls import Controls, error_text
from xpbd_ros.view.handles import Handles
from xpbd_ros.view.picking import particle_at
from xpbd_ros.view.stage import Stage, Wrench
from xpbd_ros.view.surface import sheets_of

DRAWN_PER_SECOND = 33.0
"""a little above 30, as a frame may be late"""
TOLD_PER_SECOND = 4.0
REACH = 1.5
"""radius of a click's grasp, over the spacing of the particles"""
RECENT = 60
"""frames that times are averaged over"""
LATEST = 0.1
"""delay beyond which frames are dropped [s]"""
FORCES = {'tension': tensions, 'contact force': contact_forces}
"""forces that may colour the surface, as functions of a simulation"""


class LiveView:
    """
    One scene at a time, stepped by ``run``.

    Parameters
    ----------
    server : viser server
    scene : scene file or name of a shipped scene
    overrides : keys of the scene to change
    names : scenes of the menu
    record : function that opens a recorder for (scene, simulation); None without ROS

    """

    def __init__(self, server, scene: str, overrides: dict, names: list[str],
                 record: Callable | None):
        self._server, self._overrides, self._record = server, overrides, record
        self._commands: deque[Command] = deque()
        self.name = ''
        """scene in the menu"""
        self.stage: Stage | None = None
        self.handles: Handles
        self.controls: Controls
        self._next = self._loaded(scene)    # the scene to change to; None for none
        _, self.scene, self.simulation = self._next
        server.on_client_connect(self._aim)
        self._steps = 0    # frames to compute while paused
        self._recording: bool | None = None    # whether to record from now on; None: as it is
        self.playing = True
        self.recorder: Any = None
        self._monitor: ErrorMonitor | None = None
        self._names = names
        self.step_times: deque[tuple[float, float]] = deque(maxlen=RECENT)
        """end and duration of the latest steps [s]"""
        self.frame: Frame
        self.drawing_s = 0.0
        """processor time of the loop's thread for drawing [s]"""
        self.drawn = 0
        """pictures drawn"""
        self.frames = 0
        """frames computed"""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Step in real time until ``stopped()``."""
        due = picture = told = time.monotonic()
        try:
            while not stopped():
                if self._next is not None:
                    self._change(*self._next)
                    due = time.monotonic()
                if self._recording is not None:
                    self._record_or_stop(self._recording)
                if self.playing or self._steps:
                    self._steps = max(0, self._steps - 1)
                    self._step()
                now = time.monotonic()
                if now >= picture and self._server.get_clients():
                    period = 1.0 / DRAWN_PER_SECOND
                    picture = max(picture + period, now - period)    # the mean rate is kept
                    begin = time.thread_time()
                    self._draw()
                    self.drawing_s += time.thread_time() - begin
                    self.drawn += 1
                if now - told >= 1.0 / TOLD_PER_SECOND:
                    told = now
                    self._tell()
                due = max(due + self.simulation.frame_dt, time.monotonic() - LATEST)
                time.sleep(max(0.0, due - time.monotonic()))
        finally:
            self._close()

    def _aim(self, client) -> None:
        if self.stage is not None:    # else it is aimed when the stage is there
            self.stage.aim(client)

    def put(self, *commands: Command) -> None:
        """Apply commands before the next frame."""
        self._commands.extend(commands)

    def open(self, name: str) -> None:
        """Change to another scene, between two frames; if it is not valid, say so."""
        try:
            self._next = self._loaded(name)
        except InputError as error:
            self.controls.say(str(error))

    def _loaded(self, name: str):
        scene = load_scene(name, self._overrides)
        return name, scene, compile_scene(scene)

    def play(self, on: bool) -> None:
        """Play or pause."""
        self.playing = on
        self.step_times.clear()
        self.controls.show_playing(on)

    def step_once(self) -> None:
        """Compute one frame while paused."""
        self._steps += 1

    def reset(self) -> None:
        """Go back to the scene's start."""
        self.put(Reset())
        self._steps += not self.playing

    def release_all(self) -> None:
        """Release all pins."""
        self.put(ReleaseAll())

    def record(self, on: bool) -> None:
        """Start or stop recording, between two frames."""
        self._recording = on

    # the loop's thread

    def _change(self, name: str, scene: Scene, simulation: Simulation) -> None:
        """Compile the kernels of a scene, and show it."""
        self._next = None
        self._close()
        self._server.scene.reset()
        self._server.gui.reset()
        wait = self._server.gui.add_markdown(f'**{scene.name}**: compiling for this scene; the '
                                             'first time takes some seconds')
        simulation.compile()
        wait.visible = False    # a page that gets text and removal together reports an error
        self.name, self.scene = name, scene
        self.simulation = simulation
        self.frame = simulation.frame()
        self._commands.clear()
        self.step_times.clear()
        solver = scene.top.solver
        self._monitor = ErrorMonitor(simulation, target=solver.error_target,
                                     most=solver.max_substeps)
        self.stage = Stage(self._server, sheets_of(
            (cloth.name for cloth in simulation.cloths),
            (cloth.mesh.triangles for cloth in simulation.cloths),
            (cloth.mesh.positions for cloth in simulation.cloths)), self._positions(self.frame.x))
        self.handles = Handles(self._server, self.stage.size, self.put)
        self.controls = Controls(
            self._server.gui, self, effects=simulation.effects, keys=live_keys(scene),
            colours=('none', 'strain', *(('tension',) if has_tensions(simulation) else ()),
                     *(('contact force',) if 'contact' in simulation.effects else ())),
            scenes=self._names, scene=name, contacts=True)
        self.controls.show_playing(self.playing)
        if 'pin' in simulation.effects:
            self.stage.on_click(self._click)
        self._draw()

    def _step(self) -> None:
        assert self._monitor is not None
        commands = [self._commands.popleft() for _ in range(len(self._commands))]
        begin = time.perf_counter()
        self.frame = self.simulation.step([*commands, *self._monitor.commands()],
                                          keep=self._monitor.due())
        now = time.perf_counter()
        self._monitor.look(now - begin)
        self.step_times.append((now, now - begin))
        self.frames += 1
        for _, reason in self.frame.refused:
            self.controls.say(reason)
        for text in self.frame.news:
            self.controls.say(text)
        if self.recorder is not None:
            self.recorder.frame(self.frame)
            self.recorder.values(self._monitor.values(), self.frame)

    def _positions(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the rows of each cloth."""
        return [values[cloth.particles] for cloth in self.simulation.cloths]

    def _draw(self) -> None:
        assert self.stage is not None
        stage, frame = self.stage, self.frame
        with self._server.atomic():
            forces = FORCES.get(stage.colour)
            stage.show(self._positions(frame.x), self._positions(forces(self.simulation))
                       if forces is not None else ())
            stage.show_contacts(frame.x[touching(self.simulation)] if stage.contacts
                                else frame.x[:0])
            movable = {}
            for name, state in frame.colliders.items():
                stage.show_body(name, state.entry, state.pose)
                if state.entry.shape != 'plane':
                    movable[name] = state.pose
            stage.show_wrenches(_wrenches(frame.pins), _wrenches(frame.colliders))
            stage.forget_bodies(frame.colliders)
            self.handles.show({name: pin.pose for name, pin in frame.pins.items()}, movable)

    def _click(self, origin, direction) -> None:
        """Grasp the particle next to a ray; release the pin if one holds it."""
        assert self.stage is not None
        x = self.frame.x
        particle = particle_at(x, origin, direction, self.stage.size)
        if particle is None:
            return
        for name, pin in self.frame.pins.items():
            if particle in pin.particles:
                self.put(Release(name))
                return
        gap = min(cloth.mesh.gap for cloth in self.simulation.cloths)
        used = {int(name[6:]) for name in self.frame.pins
                if name.startswith('click_') and name[6:].isdigit()}
        name = f'click_{min(set(range(len(used) + 1)) - used)}'
        px, py, pz = map(float, x[particle])
        self.put(Grasp(name, Pose((px, py, pz)), REACH * gap))

    def _tell(self) -> None:
        frame, dt, times = self.frame, self.simulation.frame_dt, list(self.step_times)
        step = sum(seconds for _, seconds in times) / max(1, len(times))
        wall = times[-1][0] - times[0][0] if len(times) > 1 else 0.0
        factor = (len(times) - 1) * dt / wall if wall else 0.0
        strain = largest_strain(self.simulation)
        contacts = self.simulation.stats().get('contacts')
        self.controls.tell([
            f'**{1e-9 * frame.time_ns:.2f} s**, {len(frame.x)} particles'
            + (', recording' if self.recorder is not None else ''),
            (f'{factor:.2f} × real time' if self.playing else 'paused')
            + f'; step {1e3 * step:.2f} ms of {1e3 * dt:.1f} ms',
            f'largest strain {100.0 * strain:.2g} %'
            + (f', {contacts} contacts' if contacts is not None else ''),
            f'error of a frame: {self._error()}',
            *(f'{name}: {norm(pin.force):.3g} N at '
              f'{", ".join(f"{c:.2f}" for c in pin.pose.position)} m'
              for name, pin in frame.pins.items())])

    def _error(self) -> str:
        """Return the latest error estimate as text."""
        latest = None if self._monitor is None else self._monitor.latest
        if latest is None:
            return 'not estimated yet'
        return error_text(latest.rms, resolved=latest.resolved,
                          time_s=1e-9 * self.simulation.time_ns(latest.frame))

    def _record_or_stop(self, on: bool) -> None:
        self._recording = None
        if not on:
            self.stop_recording()
        elif self._record is None:
            self.controls.say("recording needs ROS 2 messages: pip install 'xpbd_ros[ros]'")
        elif self.recorder is None:
            self.recorder = self._record(self.scene, self.simulation)
            self.controls.say(f'recording to {self.recorder.folder}')

    def _close(self) -> None:
        """Finish the log, and stop estimating errors."""
        self.stop_recording()
        if self._monitor is not None:
            self._monitor.close()
            self._monitor = None

    def stop_recording(self) -> None:
        """Finish the log, if one is open."""
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            recorder.close()
            self.controls.say(f'recorded {recorder.folder}')


def _wrenches(bodies: Mapping[str, Any]) -> dict[str, Wrench]:
    """Return the wrenches on pins or colliders of a frame."""
    return {name: Wrench(state.pose.position, state.force, state.torque)
            for name, state in bodies.items()}
