"""
A running scene in the browser: it steps in real time, and the page drags pins and colliders.

All that the page does becomes commands, which act between two frames and are recorded as those of
the node are, so that a recorded session repeats bit for bit. Drawing only reads frames; the state
does not depend on whether, or how fast, a browser follows.
"""

from collections import deque
from collections.abc import Callable
import time
from typing import Any

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import (
    Command,
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    ReleaseAll,
    Reset,
)
from xpbd_ros.sim.measure import largest_strain
from xpbd_ros.sim.simulation import Frame, Simulation
from xpbd_ros.view.controls import Controls
from xpbd_ros.view.stage import Sheet, Stage

DRAWN_PER_SECOND = 30.0
TOLD_PER_SECOND = 4.0
REACH = 1.5
"""radius of a click's grasp, over the spacing of the particles"""


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
        self._next = self._loaded(scene)    # the scene to change to; None for none
        server.on_client_connect(self._aim)
        self._steps = 0    # frames to compute while paused
        self._recording: bool | None = None    # whether to record from now on; None: as it is
        self.playing = True
        self.recorder: Any = None
        self._names = names
        self.frame: Frame
        self.drawing_s = 0.0
        """time spent on drawing [s]"""
        self.frames = 0
        """frames computed"""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Step in real time until ``stopped()``."""
        due = drawn = told = time.monotonic()
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
            if now - drawn >= 1.0 / DRAWN_PER_SECOND:
                drawn = now
                self._draw()
                self.drawing_s += time.monotonic() - now
            if now - told >= 1.0 / TOLD_PER_SECOND:
                told = now
                self._tell()
            due = max(due + self.simulation.frame_dt, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))
        self.stop_recording()

    def _aim(self, client) -> None:
        if hasattr(self, 'stage'):    # else it is aimed when the stage is there
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

    def step_once(self) -> None:
        """Compute one frame while paused."""
        self._steps += 1

    def reset(self) -> None:
        """Go back to the scene's start."""
        self.put(Reset())
        self._steps += not self.playing

    def record(self, on: bool) -> None:
        """Start or stop recording, between two frames."""
        self._recording = on

    # the loop's thread

    def _change(self, name: str, scene: Scene, simulation: Simulation) -> None:
        """Compile the kernels of a scene, and show it."""
        self._next = None
        self.stop_recording()
        self._server.scene.reset()
        self._server.gui.reset()
        self._server.gui.add_markdown(f'**{scene.name}**: compiling for this scene; the first '
                                      'time takes some seconds')
        simulation.compile()
        self._server.gui.reset()
        self.name, self.scene = name, scene
        self.simulation = simulation
        self.frame = simulation.frame()
        self._commands.clear()
        self._handles: dict = {}
        self._dragged: set[str] = set()
        self.stage = Stage(self._server, [_sheet(cloth) for cloth in simulation.cloths],
                           self._positions())
        self.controls = Controls(self._server.gui, self, self._names)
        if 'pin' in simulation.effects:
            self.stage.on_click(self._click)
        self._draw()

    def _step(self) -> None:
        commands = [self._commands.popleft() for _ in range(len(self._commands))]
        begin = time.perf_counter()
        self.frame = self.simulation.step(commands)
        self.controls.time(time.perf_counter() - begin)
        self.frames += 1
        for _, reason in self.frame.refused:
            self.controls.say(reason)
        for text in self.frame.news:
            self.controls.say(text)
        if self.recorder is not None:
            self.recorder.frame(self.frame)

    def _positions(self) -> list[np.ndarray]:
        return [self.frame.x[cloth.particles] for cloth in self.simulation.cloths]

    def _draw(self) -> None:
        with self._server.atomic():
            self.stage.show(self._positions())
            pins = {name: (pin.pose, pin.force) for name, pin in self.frame.pins.items()}
            self.stage.show_forces({name: (pose.position, force)
                                    for name, (pose, force) in pins.items()})
            poses = {f'pins/{name}': pose for name, (pose, _) in pins.items()}
            for name, state in self.frame.colliders.items():
                self.stage.show_body(name, state)
                if state.entry.shape != 'plane':
                    poses[f'colliders/{name}'] = state.pose
            self.stage.forget_bodies(self.frame.colliders)
            self._show_handles(poses)

    def _show_handles(self, poses: dict[str, Pose]) -> None:
        """Show a gizmo at each pin and collider; one that is dragged stays with the pointer."""
        for name in self._handles.keys() - poses.keys():
            self._handles.pop(name).remove()
            self._dragged.discard(name)
        for name, pose in poses.items():
            if name not in self._handles:
                self._handles[name] = self._handle(name, pose)
            elif name not in self._dragged:
                x, y, z, w = pose.orientation
                self._handles[name].position = pose.position
                self._handles[name].wxyz = (w, x, y, z)

    def _handle(self, path: str, pose: Pose):
        section, name = path.split('/', 1)
        handle = self._server.scene.add_transform_controls(
            f'/handles/{path}', scale=0.15 * self.stage.size, depth_test=False, opacity=0.8,
            position=pose.position, wxyz=(pose.orientation[3], *pose.orientation[:3]),
            visible=section == 'pins' or self.controls.shows_colliders)

        @handle.on_update
        async def _(event) -> None:
            (self._dragged.discard if event.phase == 'end' else self._dragged.add)(path)
            w, x, y, z = map(float, handle.wxyz)
            px, py, pz = map(float, handle.position)
            target = Pose((px, py, pz), (x, y, z, w))
            self.put(MovePin(name, target) if section == 'pins' else MoveCollider(name, target))
        return handle

    def show_collider_handles(self, shown: bool) -> None:
        """Show or hide the gizmos of colliders."""
        for path, handle in list(self._handles.items()):
            if path.startswith('colliders/'):
                handle.visible = shown

    def _click(self, origin, direction) -> None:
        """Grasp the particle next to a ray; release the pin if one holds it."""
        x = self.frame.x
        to = x - origin
        along = to @ direction
        apart = np.linalg.norm(to - along[:, None] * direction, axis=1)
        near = np.flatnonzero((apart < apart.min() + 1e-3 * self.stage.size) & (along > 0.0))
        if not len(near):
            return
        particle = int(near[along[near].argmin()])
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

    def release_all(self) -> None:
        """Release all pins."""
        self.put(ReleaseAll())

    def _tell(self) -> None:
        self.controls.tell(self.frame, largest_strain(self.simulation),
                           recording=self.recorder is not None)

    def _record_or_stop(self, on: bool) -> None:
        self._recording = None
        if not on:
            self.stop_recording()
        elif self._record is None:
            self.controls.say("recording needs ROS 2 messages: pip install 'xpbd_ros[ros]'")
        elif self.recorder is None:
            self.recorder = self._record(self.scene, self.simulation)
            self.controls.say(f'recording to {self.recorder.folder}')

    def stop_recording(self) -> None:
        """Finish the log, if one is open."""
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            recorder.close()
            self.controls.say(f'recorded {recorder.folder}')


def _sheet(cloth) -> Sheet:
    mesh = cloth.mesh
    a, b = (mesh.positions[mesh.edges[:, k]] for k in (0, 1))
    return Sheet(cloth.name, mesh.triangles, mesh.edges, np.linalg.norm(b - a, axis=1))
