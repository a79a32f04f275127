"""Gizmos at pins and colliders, which are dragged in the page."""

from collections.abc import Callable, Mapping

from xpbd_ros.sim.commands import Command, MoveCollider, MovePin, Pose

SIZE = 0.15
"""of a gizmo, over the size of the cloths"""


class Handles:
    """
    The gizmos of a page.

    Parameters
    ----------
    server : viser server
    size : size of the cloths [m]
    put : called with the commands of a drag

    """

    def __init__(self, server, size: float, put: Callable[[Command], None]):
        self._server, self._size, self._put = server, size, put
        self._handles: dict = {}
        self._dragged: set[str] = set()
        self._colliders = False
        server.on_client_disconnect(lambda _: self._dragged.clear())

    def show(self, pins: Mapping[str, Pose], colliders: Mapping[str, Pose]) -> None:
        """Show a gizmo at each pin and collider; one that is dragged stays with the pointer."""
        poses = {**{f'pins/{name}': pose for name, pose in pins.items()},
                 **{f'colliders/{name}': pose for name, pose in colliders.items()}}
        for path in self._handles.keys() - poses.keys():
            self._handles.pop(path).remove()
            self._dragged.discard(path)
        for path, pose in poses.items():
            if path not in self._handles:
                self._handles[path] = self._handle(path, pose)
            elif path not in self._dragged:
                x, y, z, w = pose.orientation
                self._handles[path].position = pose.position
                self._handles[path].wxyz = (w, x, y, z)

    def show_colliders(self, shown: bool) -> None:
        """Show or hide the gizmos of colliders."""
        self._colliders = shown
        for path, handle in list(self._handles.items()):
            if path.startswith('colliders/'):
                handle.visible = shown

    def _handle(self, path: str, pose: Pose):
        section, name = path.split('/', 1)
        command = MovePin if section == 'pins' else MoveCollider
        handle = self._server.scene.add_transform_controls(
            f'/handles/{path}', scale=SIZE * self._size, depth_test=False, opacity=0.8,
            position=pose.position, wxyz=(pose.orientation[3], *pose.orientation[:3]),
            visible=section == 'pins' or self._colliders)

        @handle.on_update
        async def _(event) -> None:
            (self._dragged.discard if event.phase == 'end' else self._dragged.add)(path)
            w, x, y, z = map(float, handle.wxyz)
            px, py, pz = map(float, handle.position)
            self._put(command(name, Pose((px, py, pz), (x, y, z, w))))
        return handle
