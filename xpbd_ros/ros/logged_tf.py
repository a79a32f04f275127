"""
Transforms of a log: the tree of TF frames, and lookups in it.

It does for a log as ``ros.tf`` does for a node, with the same interpolation as tf2, linear in the
translation; rotations by normalised linear interpolation, with IEEE operations only. tf2 itself is
no part of the ROS wheels, and a log has no node.
"""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches

from xpbd_ros.errors import InputError
from xpbd_ros.ros.pose_messages import Transform
from xpbd_ros.scene.read import unknown
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import compose, interpolated, inverse

KEPT_NS = 10 * 10**9
"""time for which transforms are kept, as in tf2 [ns]"""
MOST_NAMES = 12
"""names in an error, at most"""


@dataclass
class Edge:
    """The transforms of one TF frame in its parent."""

    parent: str
    static: bool
    stamps_ns: list[int] = field(default_factory=list)
    """rising [ns]"""
    poses: list[Pose] = field(default_factory=list)

    def add(self, stamp_ns: int, pose: Pose) -> None:
        """Add a transform; one that is not later than the last is ignored."""
        if self.static:
            self.poses = [pose]
        elif not self.stamps_ns or stamp_ns > self.stamps_ns[-1]:
            self.stamps_ns.append(stamp_ns)
            self.poses.append(pose)
            if self.stamps_ns[0] < stamp_ns - 2 * KEPT_NS:
                old = bisect_left(self.stamps_ns, stamp_ns - KEPT_NS)
                del self.stamps_ns[:old], self.poses[:old]

    def at(self, stamp_ns: int) -> Pose | None:
        """Return the pose at a time; None if it is outside the kept transforms."""
        if self.static:
            return self.poses[0]
        k = bisect_left(self.stamps_ns, stamp_ns)
        if k == len(self.stamps_ns):
            return None
        if self.stamps_ns[k] == stamp_ns:
            return self.poses[k]
        if k == 0:
            return None
        before, after = self.stamps_ns[k - 1], self.stamps_ns[k]
        return interpolated(self.poses[k - 1], self.poses[k],
                            (stamp_ns - before) / (after - before))


class LoggedTransforms:
    """A ``PoseSource`` of transforms that are given message by message."""

    name = 'TF'

    def __init__(self):
        self._edges: dict[str, Edge] = {}    # by child

    @property
    def frames(self) -> list[str]:
        """All TF frames, sorted."""
        return sorted(self._edges.keys() | {edge.parent for edge in self._edges.values()})

    def take(self, transforms: Iterable[Transform], *, static: bool) -> None:
        """Take the transforms of a message."""
        for each in transforms:
            edge = self._edges.get(each.child)
            if edge is None or edge.parent != each.parent or edge.static != static:
                edge = self._edges[each.child] = Edge(each.parent, static)
            edge.add(each.stamp_ns, each.pose)

    def clear(self) -> None:
        """Forget all transforms."""
        self._edges = {}

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the time of the latest transform from ``source`` [ns]; 0 for a static one."""
        up, down = self._paths(frame, source)
        return min((self._edges[child].stamps_ns[-1] for child in (*up, *down)
                    if not self._edges[child].static), default=0)

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the pose of TF frame ``source`` in ``frame`` at a time [ns]; 0: the latest."""
        up, down = self._paths(frame, source)
        stamp_ns = stamp_ns or self.latest_ns(frame, source)
        return compose(inverse(self._along(up, stamp_ns)), self._along(down, stamp_ns))

    def _paths(self, frame: str, source: str) -> tuple[list[str], list[str]]:
        """Return the TF frames below the nearest common one, from both ends upwards."""
        up, down = self._ancestors(frame), self._ancestors(source)
        common = next((name for name in down if name in up), None)
        if common is None:
            raise InputError(f"TF does not connect '{source}' with '{frame}'")
        return up[:up.index(common)], down[:down.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """Return a TF frame and all above it."""
        if frame not in self._edges and all(edge.parent != frame for edge in
                                            self._edges.values()):
            known = self.frames
            near = get_close_matches(frame, known)
            listed = list(dict.fromkeys([*near, *known]))[:MOST_NAMES]
            more = ['…'] * (len(known) > MOST_NAMES)
            raise InputError(f"'{frame}': {unknown(frame, [*listed, *more], 'TF frame')}")
        found = [frame]
        while (edge := self._edges.get(found[-1])) is not None:
            if edge.parent in found:
                raise InputError(f"TF has a loop at '{edge.parent}'")
            found.append(edge.parent)
        return found

    def _along(self, path: list[str], stamp_ns: int) -> Pose:
        """Return the pose of the first TF frame of a path in the parent of the last."""
        found = Pose()
        for child in path:
            pose = self._edges[child].at(stamp_ns)
            if pose is None:
                raise InputError(f"TF has no transform of '{child}' at {1e-9 * stamp_ns:.6f} s")
            found = compose(pose, found)
        return found
