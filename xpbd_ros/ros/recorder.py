"""
Record one run to one log: states, inputs as applied, state hashes; for the node and ``run``.

Messages are encoded when a frame is given, and written by a thread.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
import platform
from types import MappingProxyType

import numba
import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64

from xpbd_ros.log.background import Background
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.writer import CHECKPOINT, LogWriter, VECTOR_BITS
from xpbd_ros.ros import diagnostics
from xpbd_ros.ros.cdr import trimmed
from xpbd_ros.ros.command_messages import as_messages
from xpbd_ros.ros.guards import GUARDS, Tally
from xpbd_ros.ros.inputs import SECOND
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.sim.backend.simd import BITS, PROCESSOR
from xpbd_ros.sim.checkpoint import checkpoint
from xpbd_ros.sim.simulation import Frame

INPUT = Qos(depth=10)
SPLIT_SIZE = 4 * 10**9
"""size at which a log goes on in a new file [bytes]: it bounds the index in memory (0.7 kB per
chunk), and a FAT32 volume holds no larger file"""
EVENTS = {'method_switches'}
"""counters that go into the log as those of guards do, and are no warnings"""


class Recorder:
    """
    An open log of a run.

    Parameters
    ----------
    folder : folder of the log; must not exist
    outputs : topics of the simulation
    name : full name of the node, such as ``/cloth``
    epoch_ns : log time of simulation time 0 [ns]
    flush_period : a crash loses at most this much [s]
    checkpoint_period : period at which the complete state is written [s of simulation time]
    split_size, split_duration : of a file, at most [bytes, ns]; 0: one file
    settings : further entries of the log's metadata
    files : files that the scene refers to, by name

    A log that begins in the middle of a run holds a checkpoint of that moment. An error in writing
    is raised by one of the next calls.

    """

    def __init__(self, folder: Path, outputs: Outputs, *, name: str = '/cloth',
                 epoch_ns: int, flush_period: float = 1.0, checkpoint_period: float = 10.0,
                 split_size: int = SPLIT_SIZE, split_duration: int = 0,
                 settings: dict[str, str] | None = None,
                 files: Mapping[str, bytes] = MappingProxyType({})):
        self.folder = folder
        self.outputs = outputs
        self.epoch_ns = epoch_ns
        self._name = name
        self.checkpoint_period = checkpoint_period
        simulation = outputs.simulation
        attachments = dict(files)
        if simulation.index:
            attachments[CHECKPOINT] = checkpoint(simulation)
        self.log = LogWriter(folder, scene=outputs.scene_text,
                             settings={**environment(), **(settings or {})},
                             attachments=attachments, flush_period=flush_period,
                             split_size=split_size, split_duration=split_duration)
        for output in outputs.topics.values():
            if not output.view_only:
                self.log.add_channel(self._full(output.topic), type_name(output.kind),
                                     output.qos)
        self._background = Background()
        self._parts: list[Callable[[], object]] = []
        """tasks of the thread for the present frame"""
        self._later: set[str] = set()
        """channels that were added with their first message"""
        self._counts: dict[str, float] = {}
        self.guards = Tally()
        """the counters of guards over the recorded frames"""
        self._moved_ns, self._told_ns = 0, -SECOND    # shift of stamps as last written, when
        frame = simulation.frame()
        self._write_all(outputs.start(), frame)
        self._write_state(frame)
        self._submit()

    def _submit(self) -> None:
        """Give the thread what was collected."""
        parts, self._parts = self._parts, []
        self._background.run(parts)

    def _full(self, topic: str) -> str:
        return topic if topic.startswith('/') else f'{self._name}/{topic}'

    def _write_all(self, found: Mapping[str, bytes], frame: Frame) -> None:
        for topic, data in found.items():
            self._write(topic, self.outputs.topics[topic].kind, data,
                        self.epoch_ns + frame.time_ns, frame.index)

    def _write(self, topic: str, kind: type, data: bytes, time_ns: int, frame: int) -> None:
        """Write a message, in the thread of the log."""
        def write() -> None:
            self.log.write(self._full(topic), trimmed(data, kind), time_ns=time_ns, frame=frame)
        self._parts.append(write)

    def _write_state(self, frame: Frame) -> None:
        time_ns = self.epoch_ns + frame.time_ns
        self._write_all(self.outputs.frame(frame, time_ns), frame)
        self._write_all(self.outputs.state(frame, time_ns), frame)
        self._write_all({'state_hash': self.outputs.hash()}, frame)

    def frame(self, frame: Frame, encoded: dict[str, bytes] | None = None,
              stamp_ns: int | None = None) -> None:
        """
        Write a frame and the inputs that acted on it.

        Parameters
        ----------
        frame : the frame just computed
        encoded : its serialized messages, by topic; None to serialize them here
        stamp_ns : their stamp [ns]; None for simulation time after ``epoch_ns``

        """
        outputs = self.outputs
        before_ns = self.epoch_ns + outputs.simulation.time_ns(frame.index - 1)
        stamp_ns = self.epoch_ns + frame.time_ns if stamp_ns is None else stamp_ns
        if encoded is None:
            encoded = outputs.frame(frame, stamp_ns)
        for topic, message in as_messages(frame.applied, outputs.frame_id, stamp_ns):
            self._write_one(topic, message, before_ns, frame.index)
        self._write_all(encoded, frame)
        self._write_all({'state_hash': outputs.hash()}, frame)
        period = max(1, round(self.checkpoint_period * outputs.simulation.frame_rate))
        if frame.index % period == 0:
            self._write_all(outputs.state(frame, stamp_ns), frame)
        self._write_guards(frame, stamp_ns)
        self._submit()

    def flush_if_due(self) -> None:
        """Flush if the flush period has passed; for times without frames."""
        self._background.check()
        if self.log.flush_is_due and self._background.idle:
            self._background.run([self.log.flush_if_due])

    def _write_one(self, topic: str, message, time_ns: int, frame: int) -> None:
        kind = type(message)
        if topic not in self._later:
            self._parts.append(partial(self.log.add_channel, self._full(topic), type_name(kind),
                                       INPUT))
            self._later.add(topic)
        self._write(topic, kind, serialize_message(message), time_ns, frame)

    def _write_guards(self, frame: Frame, stamp_ns: int) -> None:
        """Write the counters of GUARDS and the shift of the stamps, where they changed."""
        stats = self.outputs.simulation.stats()
        self.guards.look(stats)
        counts = {name: stats[name] for name in (*GUARDS, *EVENTS) if stats.get(name)}
        moved_ns = stamp_ns - self.epoch_ns - frame.time_ns
        tell = (abs(moved_ns - self._moved_ns) > self.outputs.simulation.time_ns(1)
                and frame.time_ns - self._told_ns >= SECOND)
        if counts == self._counts and not tell:
            return
        self._counts, self._moved_ns, self._told_ns = counts, moved_ns, frame.time_ns
        time_ns = self.epoch_ns + frame.time_ns
        self._write_one('/diagnostics', diagnostics.message(
            self._name.lstrip('/'), 'WARN' if counts.keys() - EVENTS else 'OK', 'guards',
            {**counts, 'stamps_moved_s': 1e-9 * moved_ns}, stamp_ns), time_ns, frame.index)

    def values(self, values: Mapping[str, float], frame: Frame) -> None:
        """Write numbers about a frame, by their topics below the node's name."""
        for topic, value in values.items():
            self._write_one(topic, Float64(data=value), self.epoch_ns + frame.time_ns, frame.index)
        if values:
            self._submit()

    def close(self) -> None:
        """Write all that waits, and close the log."""
        try:
            self._background.close()
        finally:
            self.log.close()


def environment() -> dict[str, str]:
    """Return the versions, the processor and its vectors that a run is computed with."""
    return {'python': platform.python_version(), 'numpy': np.__version__,
            'numba': numba.__version__, 'cpu': PROCESSOR, VECTOR_BITS: str(BITS)}


def type_name(kind: type) -> str:
    """Return the name of a message type, such as 'sensor_msgs/msg/PointCloud2'."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
