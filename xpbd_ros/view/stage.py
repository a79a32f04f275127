"""The 3D scene of a page: cloths, colliders, contacts, and arrows for forces."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from xpbd_ros.export.body import Body
from xpbd_ros.sim.commands import Pose
from xpbd_ros.view.bodies import add_body
from xpbd_ros.view.surface import Sheet, Surface, TAUT

COLOURS = ((42, 120, 181), (193, 128, 58), (74, 154, 98), (138, 95, 176))
"""of the cloths, in turn"""
FORCE, TORQUE = (40, 40, 40), (124, 58, 170)
"""of arrows"""
EYE = (1.5, -3.0, 1.1)
"""from the centre of the cloths to the camera at first, over their size"""
FIELD_OF_VIEW = 0.8
"""vertical [rad]"""
PANEL = 0.2
"""sideways offset of the camera, so that the panel does not cover the cloths, over its distance"""
AMBIENT = 1.2
"""light on sides that face away from the lamps"""
FORCE_SCALE = 0.1
"""length of an arrow per force [m/N]"""
TORQUE_SCALE = 1.0
"""length of an arrow per torque [m/(N m)]"""
LEAST_ARROW = 1e-3
"""length below which there is no arrow [m]"""
STRAIN_SHOWN = 0.05
"""strain of the darkest colour"""
LEAST_FORCE = 1e-4
"""force below which no colour is the darkest [N]"""
FEW = 0.05
"""share of the loaded particles that may have the darkest colour"""
PALE = np.array([255, 255, 255])
TOUCHING = (217, 130, 43)
"""colour of contacts"""
Vector = np.ndarray | Sequence[float]


class Wrench(NamedTuple):
    """A force of the cloth at a point, and a torque about it."""

    point: Vector
    """[m]"""
    force: Vector
    """[N]"""
    torque: Vector
    """[N m]"""


class Stage:
    """
    The three-dimensional part of a page.

    Parameters
    ----------
    server : viser server
    sheets : cloths
    positions : of the particles of each cloth [m], shape (particles, 3)
    seen : points that the camera is to see at first [m], shape (points, 3); None: the cloths

    """

    def __init__(self, server, sheets: Sequence[Sheet], positions: Sequence[np.ndarray],
                 seen: np.ndarray | None = None):
        self._server, self._sheets = server, sheets
        self.colour = 'none'
        """quantity that colours the surface: a word of ``controls.COLOURS``"""
        self.contacts = False
        """True if contacts are drawn"""
        self._surfaces = [Surface(server, sheet, x, COLOURS[k % len(COLOURS)])
                          for k, (sheet, x) in enumerate(zip(sheets, positions))]
        self._arrows: dict = {}
        self.bodies: dict = {}
        self._entries: dict = {}
        everything = np.concatenate(positions)
        self.size = float(np.ptp(everything, axis=0).max()) or 1.0
        self._touching = server.scene.add_point_cloud(
            '/contacts', everything[:1].astype(np.float32), TOUCHING, precision='float32',
            point_size=0.012 * self.size, point_shape='circle', visible=False)
        if seen is None:
            self.centre, distance = everything.mean(axis=0), self.size
        else:
            self.centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
            radius = 0.5 * float(np.linalg.norm(np.ptp(seen, axis=0))) or 1.0
            distance = radius / np.sin(0.5 * FIELD_OF_VIEW) / np.linalg.norm(EYE)
        self._back = distance * np.array(EYE)
        aside = np.cross([0.0, 0.0, 1.0], EYE)
        self._aside = PANEL * np.linalg.norm(self._back) * aside / np.linalg.norm(aside)
        server.scene.set_up_direction('+z')
        server.scene.configure_default_lights(cast_shadow=True)
        server.scene.add_light_ambient('/ambient', intensity=AMBIENT)
        self.aim_all()

    def aim_all(self, *, panel: bool = True) -> None:
        """
        Turn the camera to the cloths, in open browsers and in those that come later.

        The page has room for a panel at the right if ``panel``.
        """
        camera, at = self._server.initial_camera, self.centre + panel * self._aside
        camera.position, camera.look_at = tuple(at + self._back), tuple(at)
        camera.fov = FIELD_OF_VIEW
        for client in self._server.get_clients().values():
            self.aim(client)

    def aim(self, client) -> None:
        """Turn a browser's camera to the cloths, beside the panel."""
        at = self.centre + self._aside
        client.camera.position, client.camera.look_at = tuple(at + self._back), tuple(at)
        client.camera.fov = FIELD_OF_VIEW

    def show(self, positions: Sequence[np.ndarray], forces: Sequence[np.ndarray] = ()) -> None:
        """
        Show the particles of each cloth.

        Parameters
        ----------
        positions : by cloth [m], shape (particles, 3)
        forces : by cloth, the forces [N] that colour the surface, shape (particles,); empty for
            none

        """
        values: list[np.ndarray | None] = [None] * len(self._sheets)
        if len(forces):
            full = full_force(np.concatenate(forces))
            values = [force[sheet.triangles].max(axis=1) / full
                      for sheet, force in zip(self._sheets, forces)]
        elif self.colour == 'strain':
            values = [sheet.strains_of_triangles(x) / STRAIN_SHOWN
                      for sheet, x in zip(self._sheets, positions)]
        for surface, x, each in zip(self._surfaces, positions, values):
            surface.show(x, each)

    def show_contacts(self, points: np.ndarray) -> None:
        """Show particles that touch a collider at these points [m], shape (contacts, 3)."""
        self._touching.visible = self.contacts and len(points) > 0
        if self._touching.visible:
            self._touching.points = points.astype(np.float32)

    def show_wrenches(self, pins: Mapping[str, Wrench], colliders: Mapping[str, Wrench]) -> None:
        """
        Show the wrenches of the cloth on pins and colliders.

        A collider's is shown at its central axis, unless that is far away.
        """
        wrenches = {**{f'pins/{name}': wrench for name, wrench in pins.items()},
                    **{f'colliders/{name}': on_axis(wrench, self.size)
                       for name, wrench in colliders.items()}}
        arrows = {f'{kind}/{name}': (point, scale * np.asarray(vector, float), colour)
                  for name, (point, force, torque) in wrenches.items()
                  for kind, vector, scale, colour in (
                      ('forces', force, FORCE_SCALE, FORCE),
                      ('torques', torque, TORQUE_SCALE, TORQUE))
                  if scale * np.linalg.norm(vector) > LEAST_ARROW}
        for name in self._arrows.keys() - arrows.keys():
            self._arrows.pop(name).remove()
        for name, (point, vector, colour) in arrows.items():
            ends = np.array([[point, point + vector]], np.float32)
            if name in self._arrows:
                self._arrows[name].points = ends
            else:
                self._arrows[name] = self._server.scene.add_arrows(
                    f'/{name}', ends, colour, shaft_radius=0.004 * self.size,
                    head_radius=0.012 * self.size, head_length=0.03 * self.size)

    def show_body(self, name: str, entry, pose: Pose) -> None:
        """Show a collider, by its entry in the scene, at a pose."""
        x, y, z, w = pose.orientation
        position, wxyz = tuple(pose.position), (w, x, y, z)
        if self._entries.get(name) is not entry:
            if name in self.bodies:
                self.bodies[name].remove()
            self._entries[name] = entry
            self.bodies[name] = add_body(self._server.scene, f'/colliders/{name}', entry,
                                         {'position': position, 'wxyz': wxyz}, self.size)
        else:
            self.bodies[name].position, self.bodies[name].wxyz = position, wxyz

    def on_click(self, act: Callable) -> None:
        """Call ``act(origin, direction)`` with the ray of a click on a cloth."""
        for surface in self._surfaces:
            surface.on_click(
                lambda event: act(np.array(event.ray_origin), np.array(event.ray_direction)))

    def forget_bodies(self, known) -> None:
        """Remove the colliders that are no longer known."""
        for name in self.bodies.keys() - set(known):
            self.bodies.pop(name).remove()
            del self._entries[name]


def full_force(forces: np.ndarray) -> float:
    """Return the force of the darkest colour [N]: all but the largest FEW are below it."""
    loaded = forces[forces > 0.0]
    return max(LEAST_FORCE, float(np.quantile(loaded, 1.0 - FEW)) if len(loaded) else 0.0)


def ramp(shares: np.ndarray) -> np.ndarray:
    """Return sRGB bytes from white (0) to red (1), shape (..., 3)."""
    return (PALE + shares[..., None] * (TAUT - PALE)).astype(np.uint8)


def wrenches_of(bodies: Iterable[Body]) -> dict[str, Wrench]:
    """Return the wrenches on recorded pins or colliders, by name."""
    return {body.name: Wrench(body.position, body.force, body.torque) for body in bodies}


def on_axis(wrench: Wrench, farthest: float) -> Wrench:
    """
    Return a wrench at the point of its central axis that is next to its own point.

    There the torque is parallel to the force. If the axis is farther away than ``farthest`` [m],
    as that of a couple is, the wrench is returned as it is.
    """
    force, torque = np.asarray(wrench.force, float), np.asarray(wrench.torque, float)
    square = float(force @ force)
    arm = np.cross(force, torque)    # times the square of the force
    if not np.linalg.norm(arm) <= farthest * square or square == 0.0:
        return wrench
    return Wrench(np.asarray(wrench.point, float) + arm / square, force,
                  (torque @ force) / square * force)
