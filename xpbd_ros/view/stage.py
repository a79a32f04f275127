"""The 3D scene of a page: cloths, colliders, contacts, and arrows for forces."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.mesh import edges
from xpbd_ros.view.bodies import add_body

COLOURS = ((42, 120, 181), (193, 128, 58), (74, 154, 98), (138, 95, 176))
"""of the cloths, in turn"""
FORCE = (40, 40, 40)
EYE = (1.5, -3.0, 1.1)
"""from the centre of the cloths to the camera at first, over their size"""
FIELD_OF_VIEW = 0.8
"""vertical [rad]"""
PANEL = 0.2
"""displacement of the camera that moves the cloths from behind the panel, over its distance"""
AMBIENT = 1.2
"""light on sides that face away from the lamps"""
FORCE_SCALE = 0.1
"""length of an arrow per force [m/N]"""
STRAIN_SHOWN = 0.05
"""strain of the darkest colour"""
LEAST_FORCE = 0.01
"""tension below which no edge is red [N]"""
PALE = np.array([255, 255, 255])
TOUCHING = (217, 130, 43)
"""colour of contacts"""
Vector = np.ndarray | Sequence[float]
Arrow = tuple[Vector, Vector]
"""point [m] and force [N]"""
SLACK, TAUT = np.array([66, 133, 244]), np.array([219, 68, 55])
"""colours of a compressed and of a stretched edge"""


@dataclass(frozen=True)
class Sheet:
    """A cloth: its triangles and edges."""

    name: str
    triangles: np.ndarray
    """shape (triangles, 3)"""
    edges: np.ndarray
    """shape (edges, 2)"""
    rest_length: np.ndarray
    """[m], shape (edges,)"""


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
        ends = edges(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
        length = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
        found.append(Sheet(name, corners, ends, np.maximum(length, 1e-9)))
    return found


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
        """quantity that colours the edges: 'strain', 'force' or 'none'"""
        self.contacts = False
        """True if contacts are drawn"""
        self._meshes = [server.scene.add_mesh_simple(
            f'/cloths/{sheet.name}', x.astype(np.float32), sheet.triangles, side='double',
            color=COLOURS[k % len(COLOURS)])
            for k, (sheet, x) in enumerate(zip(sheets, positions))]
        self._edges = [server.scene.add_line_segments(
            f'/strain/{sheet.name}', x[sheet.edges].astype(np.float32),
            np.zeros((len(sheet.edges), 2, 3), np.uint8), thickness=2.0,
            thickness_units='screen', visible=False)
            for sheet, x in zip(sheets, positions)]
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
        self._aside = 0.0 * aside if seen is None else (
            PANEL * np.linalg.norm(self._back) * aside / np.linalg.norm(aside))
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

    def show(self, positions: Sequence[np.ndarray], tensions: Sequence[np.ndarray] = ()) -> None:
        """
        Show the particles of each cloth.

        Parameters
        ----------
        positions : by cloth [m], shape (particles, 3)
        tensions : by cloth [N], shape (particles,); used for ``colour`` 'force'

        """
        most = max((float(each.max(initial=0.0)) for each in tensions), default=0.0)
        for k, (sheet, mesh, lines, x) in enumerate(zip(self._sheets, self._meshes, self._edges,
                                                        positions)):
            x = x.astype(np.float32)
            mesh.vertices = x
            forced = self.colour == 'force' and len(tensions) > 0
            lines.visible = forced or self.colour == 'strain'
            if lines.visible:
                ends = x[sheet.edges]
                lines.points = ends
                lines.colors = (ramp(tensions[k][sheet.edges] / max(most, LEAST_FORCE)) if forced
                                else strain_colours(ends, sheet.rest_length))

    def show_contacts(self, points: np.ndarray) -> None:
        """Show particles that touch a collider at these points [m], shape (contacts, 3)."""
        self._touching.visible = self.contacts and len(points) > 0
        if self._touching.visible:
            self._touching.points = points.astype(np.float32)

    def show_forces(self, forces: Mapping[str, Arrow]) -> None:
        """Show forces of the cloth [N] at points [m], by name."""
        for name in self._arrows.keys() - forces.keys():
            self._arrows.pop(name).remove()
        for name, (position, force) in forces.items():
            ends = np.array([[position, np.add(position, FORCE_SCALE * np.asarray(force))]],
                            np.float32)
            if name in self._arrows:
                self._arrows[name].points = ends
            else:
                self._arrows[name] = self._server.scene.add_arrows(
                    f'/forces/{name}', ends, FORCE, shaft_radius=0.004 * self.size,
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
        for mesh in self._meshes:
            @mesh.on_click
            def _(event) -> None:
                act(np.array(event.ray_origin), np.array(event.ray_direction))

    def forget_bodies(self, known) -> None:
        """Remove the colliders that are no longer known."""
        for name in self.bodies.keys() - set(known):
            self.bodies.pop(name).remove()
            del self._entries[name]


def ramp(shares: np.ndarray) -> np.ndarray:
    """Return sRGB bytes from white (0) to red (1), shape (..., 3)."""
    return (PALE + shares[..., None] * (TAUT - PALE)).astype(np.uint8)


def line_of_action(position: Sequence[float], force: Vector, torque: Vector) -> np.ndarray:
    """
    Return the point of a wrench's line of action next to a body.

    Parameters
    ----------
    position : of the body [m]
    force : [N], shape (3,)
    torque : about the position [N m], shape (3,)

    """
    square = float(np.dot(force, force))
    return np.asarray(position) + (np.cross(force, torque) / square if square else 0.0)


def strain_colours(ends: np.ndarray, rest_length: np.ndarray) -> np.ndarray:
    """
    Return the colours of edges by their strain.

    Parameters
    ----------
    ends : both ends of each edge [m], shape (edges, 2, 3)
    rest_length : [m], shape (edges,)

    Returns
    -------
    sRGB bytes, shape (edges, 2, 3): white without strain, red where stretched, blue where
    compressed

    """
    strain = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / rest_length - 1.0
    share = np.clip(np.abs(strain) / STRAIN_SHOWN, 0.0, 1.0)[:, None]
    colour = np.where((strain > 0.0)[:, None], TAUT, SLACK)
    return np.repeat((255.0 + share * (colour - 255.0)).astype(np.uint8)[:, None], 2, axis=1)
