"""
TF: the only file that knows tf2.

Lookups never wait: a transform is there or refused with the reason. Subscriptions to ``/tf`` and
``/tf_static`` are served by the node's executor, lookups are thread-safe. Nothing is imported or
subscribed before ``Transforms`` is created.
"""

from rclpy.time import Time

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import unit

MISSING = 'needs tf2_ros (sudo apt install ros-jazzy-tf2-ros-py)'


class Transforms:
    """
    The transforms that a node has received.

    Parameters
    ----------
    node : creates the subscriptions

    Raises
    ------
    InputError : tf2_ros is not installed

    """

    name = 'TF'

    def __init__(self, node):
        try:
            import tf2_ros
        except ImportError as error:
            raise InputError(f'{MISSING}: {error}') from None
        self._errors = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the time of the latest transform from ``source`` [ns]; 0 for a static one."""
        try:
            return self._buffer.get_latest_common_time(frame, source).nanoseconds
        except self._errors as error:
            raise InputError(_reason(error)) from None

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the pose of TF frame ``source`` in ``frame`` at a time [ns]; 0: the latest."""
        try:
            found = self._buffer.lookup_transform_core(frame, source, Time(nanoseconds=stamp_ns))
        except self._errors as error:
            raise InputError(_reason(error)) from None
        t, q = found.transform.translation, found.transform.rotation
        return Pose((t.x, t.y, t.z), unit((q.x, q.y, q.z, q.w)))

    def clear(self) -> None:
        """Forget all transforms but the static ones, those that wait to be read included."""
        waiting = self._listener.tf_sub
        with waiting.handle:
            while waiting.handle.take_message(waiting.msg_type, False) is not None:
                pass
        self._buffer.clear()

    def close(self) -> None:
        """Destroy the subscriptions."""
        self._listener.unregister()


def _reason(error: Exception) -> str:
    """Return tf2's message as one line."""
    return ' '.join(str(error).split()).rstrip('.')
