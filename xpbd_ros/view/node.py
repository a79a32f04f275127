"""
A running node in the browser, over DDS: the page for a robot without RViz.

All that is shown comes from the node's topics, and all that the page does goes to its topics,
services and parameters, as from any other program.
"""

from collections.abc import Callable, Mapping
import time

import numpy as np
from numpy.linalg import norm

from xpbd_ros.errors import InputError
from xpbd_ros.export.body import Body
from xpbd_ros.export.states import bodies_of
from xpbd_ros.ros.cloth_client import ClothClient
from xpbd_ros.ros.inputs import read_colliders
from xpbd_ros.scene.model import live_keys, Scene
from xpbd_ros.sim.commands import Click, Command, PlaceCollider, Pose
from xpbd_ros.sim.contact.collider_entries import Entry, shape_of
from xpbd_ros.view.controls import Controls, error_text
from xpbd_ros.view.handles import Handles
from xpbd_ros.view.picking import particle_at
from xpbd_ros.view.stage import Stage, wrenches_of
from xpbd_ros.view.surface import sheets_of

PERIOD = 1.0 / 30.0
"""of the pictures [s]"""
TOLD_PER_SECOND = 4.0
SILENT = 2.0
"""time without a message after which the page says so [s]"""


class NodeView:
    """
    The page of a node.

    Parameters
    ----------
    server : viser server
    client : connected to the node
    scene : the node's scene

    """

    def __init__(self, server, client: ClothClient, scene: Scene):
        self._server, self._client = server, client
        self.stage: Stage | None = None
        self.handles: Handles
        self.controls: Controls
        server.on_client_connect(self._aim)
        client.told = self.say
        self._show_scene(scene)
        self.frames = 0
        """pictures drawn"""

    def _aim(self, browser) -> None:
        if self.stage is not None:    # else it is aimed when the stage is there
            self.stage.aim(browser)

    def say(self, text: str) -> None:
        """Show a message in the panel."""
        self.controls.say(text)

    def _show_scene(self, scene: Scene) -> None:
        """Begin a page for a scene."""
        client, server = self._client, self._server
        server.scene.reset()
        server.gui.reset()
        self._text = client.scene_text
        self._cloths = list(scene.cloths)
        self._rate = scene.top.frame_rate
        self._triangles = client.triangles
        self._entries = dict(scene.sections.get('colliders', {}))
        self._unseen: set[str] = set()
        start = [client.start[cloth] for cloth in self._cloths]
        self._counts = [len(x) for x in start]
        self.stage = Stage(server, sheets_of(self._cloths, [
            client.triangles[cloth] for cloth in self._cloths], start), start)
        self.handles = Handles(server, self.stage.size, self.put)
        self.controls = Controls(server.gui, self, effects=scene.effect_names,
                                 keys=live_keys(scene), colours=('none', 'strain'))
        if 'pin' in scene.effect_names:
            self.stage.on_click(self._click)
        self._draw()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Show the latest messages until ``stopped()``."""
        told, count = time.monotonic(), -1
        while not stopped():
            time.sleep(PERIOD)
            if (self._client.scene_text != self._text
                    or self._client.triangles is not self._triangles):
                self._change()
            if self._client.count != count and self._server.get_clients() and self._fits():
                count = self._client.count
                self._draw()
                self.frames += 1
            if time.monotonic() - told >= 1.0 / TOLD_PER_SECOND:
                told = time.monotonic()
                self._tell()

    def _change(self) -> None:
        """Show new values of live keys; begin again where the node has another scene."""
        self._text = self._client.scene_text
        try:
            scene = self._client.scene()
        except InputError as error:
            self.say(str(error))
            return
        if list(scene.cloths) != self._cloths:
            self._client.listen_to(scene)
            self._client.wait_for_meshes(scene)
        elif self._client.triangles is self._triangles:
            self.controls.refresh(live_keys(scene))
            return
        self._show_scene(scene)

    # interface of the panel (``controls``)

    def put(self, *commands: Command) -> None:
        """Send commands to the node."""
        self._client.put(*commands)

    def play(self, on: bool) -> None:
        """Play or pause."""
        self._client.call('play' if on else 'pause', lambda: self.controls.show_playing(on))

    def step_once(self) -> None:
        """Compute one frame while paused."""
        self._client.call('step')

    def reset(self) -> None:
        """Go back to the scene's start."""
        self._client.call('reset')

    def release_all(self) -> None:
        """Release all pins."""
        self._client.call('release_all')

    def record(self, on: bool) -> None:
        """Start or stop recording."""
        self._client.record(on)

    def open(self, name: str) -> None:
        """Refuse: the node reads its scene when it is configured."""

    def _click(self, origin, direction) -> None:
        """Pin the particle next to a ray, or release the pin that holds it."""
        assert self.stage is not None
        x = np.concatenate(self._positions())
        particle = particle_at(x, origin, direction, self.stage.size)
        if particle is not None:
            px, py, pz = map(float, x[particle])
            self.put(Click((px, py, pz)))

    # the loop's thread

    def _positions(self) -> list[np.ndarray]:
        found = self._client.positions
        return [found[cloth] for cloth in self._cloths]

    def _fits(self) -> bool:
        """Return whether the clouds are those of the cloths that are shown."""
        return [len(x) for x in self._positions()] == self._counts

    def _draw(self) -> None:
        assert self.stage is not None
        stage = self.stage
        pins, colliders = bodies_of(self._client.pins), bodies_of(self._client.colliders)
        self._note_placed()
        with self._server.atomic():
            stage.show(self._positions())
            for body in colliders:
                self._show_body(body)
            stage.show_wrenches(wrenches_of(pins), wrenches_of(colliders))
            stage.forget_bodies({body.name for body in colliders})
            self.handles.show({pin.name: Pose(pin.position, pin.orientation) for pin in pins}, {
                body.name: Pose(body.position, body.orientation) for body in colliders
                if body.name in self._entries and self._entries[body.name].shape != 'plane'})

    def _note_placed(self) -> None:
        """Note the shapes of colliders that other programs place on ~/colliders."""
        for message in self._client.take_placed():
            try:
                commands = read_colliders(message, self._client.frame_id)
            except InputError:    # the node refuses it too
                continue
            for command in commands:
                if isinstance(command, PlaceCollider) and command.shape != 'mesh':
                    self._entries[command.collider] = Entry(
                        position=command.pose.position, orientation=command.pose.orientation,
                        **{command.shape: shape_of(command.shape, command.size)})

    def _show_body(self, body: Body) -> None:
        """Show a collider; say once if its shape is not known here."""
        assert self.stage is not None
        if body.name in self._unseen:
            return
        try:
            if body.name not in self._entries:
                raise InputError('its shape is not known here')
            self.stage.show_body(body.name, self._entries[body.name],
                                 Pose(body.position, body.orientation))
        except InputError as error:
            self._unseen.add(body.name)
            self.say(f'collider {body.name} is not shown: {error}')

    def _tell(self) -> None:
        client, status = self._client, self._client.status
        silent = time.monotonic() - client.heard
        activity = status.get('message', '')
        for word, playing in (('stepping', True), ('waiting', False)):
            if activity.startswith(word):
                self.controls.show_playing(playing)
        count = sum(len(x) for x in client.positions.values())
        seconds = 1e-9 * (client.time_ns - int(status.get('epoch_ns', client.time_ns)))
        rows = [f'**{client.name}** at {seconds:.2f} s, {count} particles']
        if silent > SILENT:
            rows.append(f'**no message for {silent:.0f} s**')
        if status:
            rows += [
                f'{float(status["real_time_factor"]):.2f} × real time; step '
                f'{float(status["step_ms_p50"]):.2f} ms',
                f'largest strain {100.0 * float(status["strain_max"]):.2g} %'
                + (f', {status["contacts"]} contacts' if 'contacts' in status else ''),
                f'error of a frame: {estimated_error(status, self._rate)}', activity]
        rows += [f'{pin.name}: {norm(pin.force):.3g} N at '
                 f'{", ".join(f"{c:.2f}" for c in pin.position)} m'
                 for pin in bodies_of(client.pins)]
        self.controls.tell(rows)


def estimated_error(status: Mapping[str, str], rate: float) -> str:
    """
    Return the error estimate of /diagnostics as text.

    Parameters
    ----------
    status : values of /diagnostics
    rate : frames per second of the node's scene

    """
    if 'error_m' not in status:
        return 'not estimated yet'
    resolved = status['error_m'] != 'under-resolved'
    return error_text(float(status['error_m']) if resolved else 0.0, resolved=resolved,
                      time_s=int(status['error_frame']) / rate)
