"""The 3D scene of a page: cloths, colliders, and arrows for the forces on pins."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xpbd_ros.view.bodies import add_body

COLOURS = ((42, 120, 181), (193, 128, 58), (74, 154, 98), (138, 95, 176))
"""of the cloths, in turn"""
FORCE = (40, 40, 40)
EYE = (1.5, -3.0, 1.1)
"""from the centre of the cloths to the camera at first, over their size"""
FIELD_OF_VIEW = 0.8
"""vertical [rad]"""
AMBIENT = 1.2
"""light on sides that face away from the lamps"""
FORCE_SCALE = 0.1
"""length of an arrow per force [m/N]"""
STRAIN_SHOWN = 0.05
"""strain of the darkest colour"""
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


class Stage:
    """
    The three-dimensional part of a page.

    Parameters
    ----------
    server : viser server
    sheets : cloths
    positions : of the particles of each cloth [m], shape (particles, 3)

    """

    def __init__(self, server, sheets: Sequence[Sheet], positions: Sequence[np.ndarray]):
        self._server, self._sheets = server, sheets
        self.strain = False
        """True if the edges are drawn, coloured by strain"""
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
        self.centre = everything.mean(axis=0)
        self.size = float(np.ptp(everything, axis=0).max()) or 1.0
        server.scene.set_up_direction('+z')
        server.scene.configure_default_lights(cast_shadow=True)
        server.scene.add_light_ambient('/ambient', intensity=AMBIENT)
        server.initial_camera.position = tuple(self.centre + self.size * np.array(EYE))
        server.initial_camera.look_at = tuple(self.centre)
        for client in server.get_clients().values():
            self.aim(client)

    def aim(self, client) -> None:
        """Turn a browser's camera to the cloths."""
        client.camera.position = tuple(self.centre + self.size * np.array(EYE))
        client.camera.look_at = tuple(self.centre)
        client.camera.fov = FIELD_OF_VIEW

    def show(self, positions: Sequence[np.ndarray]) -> None:
        """Show the particles of each cloth at these positions [m]."""
        for sheet, mesh, lines, x in zip(self._sheets, self._meshes, self._edges, positions):
            x = x.astype(np.float32)
            mesh.vertices = x
            lines.visible = self.strain
            if self.strain:
                ends = x[sheet.edges]
                lines.points = ends
                lines.colors = strain_colours(ends, sheet.rest_length)

    def show_forces(self, forces: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> None:
        """Show the force of the cloth [N] at the position [m] of each pin, by name."""
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

    def show_body(self, name: str, state) -> None:
        """Show a collider at its pose; ``state`` is its ``ColliderState``."""
        x, y, z, w = state.pose.orientation
        position, wxyz = tuple(state.pose.position), (w, x, y, z)
        if self._entries.get(name) is not state.entry:
            if name in self.bodies:
                self.bodies[name].remove()
            self._entries[name] = state.entry
            self.bodies[name] = add_body(self._server.scene, f'/colliders/{name}', state.entry,
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
