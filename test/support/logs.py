"""A small log with known content, states and inputs of a log, and messages as CDR."""

from pathlib import Path
import random
import struct

from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.ros.recorder import Recorder
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.files import as_attachments
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim.commands import Grasp, MovePin, Pose, Release, SetKey

SHEET = """
duration: 0.25
cloths:
  sheet:
    grid: {size: [0.6, 0.2], resolution: [7, 5]}
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}}
pins:
  left: {cloth: sheet, at: corner_00, motion: [[0.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0, 0.1]]}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 8}
"""
"""a scene whose corner is moved"""
HAND = Grasp('hand', Pose((0.6, 0.2, 0.0)), 0.05)
COMMANDS = {2: [HAND, SetKey('gravity', (0.0, 0.0, -8.0)),
                SetKey('cloths.sheet.effects.stretch.warp', 250.0)],
            5: [MovePin('hand', Pose((0.6, 0.2, 0.05)))], 9: [Release('hand')]}
"""inputs for it, by frame"""


def sample_log(folder: Path, *, frames: int = 60, frame_ns: int = 16_666_667,
               start_ns: int = 1_700_000_000_000_000_000, filling: int = 40) -> Path:
    """Write a latched scene at frame 0, then a counter and a text in each frame."""
    noise = random.Random(1)    # does not compress
    with LogWriter(folder, scene='gravity: [0.0, 0.0, -9.8]\n', settings={'seed': '7'},
                   flush_period=3600.0) as log:    # no chunk ends where the machine was slow
        log.add_channel('/cloth/scene', 'std_msgs/msg/String',
                        Qos(durability='transient_local', depth=1))
        log.add_channel('/cloth/count', 'std_msgs/msg/UInt64', Qos(depth=100))
        log.add_channel('/cloth/text', 'std_msgs/msg/String', Qos(depth=100))
        log.write('/cloth/scene', cdr_string('the scene'), time_ns=start_ns, frame=0)
        for frame in range(frames):
            time_ns = start_ns + frame * frame_ns
            log.write('/cloth/count', cdr_uint64(frame), time_ns=time_ns, frame=frame)
            text = noise.randbytes(filling).hex()
            log.write('/cloth/text', cdr_string(text), time_ns=time_ns, frame=frame)
    return folder


def recorded(scene, folder: Path, commands: dict, *, begin: int = 0, frames: int = 12) -> Path:
    """Step a scene with commands by frame, record it from a frame on, and return the log."""
    loaded = load_scene(str(scene))
    simulation = compile_scene(loaded)
    recorder, text = None, scene_text(loaded, simulation.solver)
    outputs = Outputs(simulation, 'world', text)
    for index in range(frames + 1):
        if index == begin:
            recorder = Recorder(folder, outputs, epoch_ns=10**18,
                                files=as_attachments(loaded))
        if index == frames:
            break
        frame = simulation.step(commands.get(index + 1, ()))
        assert not frame.refused
        keys = {each.key: each.value for each in frame.applied if isinstance(each, SetKey)}
        if keys and recorder is None:
            loaded = scene_from_mapping(loaded.raw, where=str(scene), name='scene',
                                        overrides=keys)
            outputs.scene(scene_text(loaded, simulation.solver))
        if recorder is not None:
            recorder.frame(frame)
    assert recorder is not None
    recorder.close()
    return folder


def state_hashes(run) -> dict[int, int]:
    """Return the hash of each frame of a log."""
    reader = LogReader(run)
    assert reader.whole
    (topic,) = (topic for topic in reader.topics if topic.endswith('/state_hash'))
    return {message.frame: struct.unpack_from('<Q', message.data, 4)[0]
            for message in reader.messages({topic})}


def recorded_inputs(run) -> list[tuple[int, str]]:
    """Return the frames at which there was an input, and its topic."""
    known = ('pins', 'pin_targets', 'colliders', 'collider_states', 'wind', 'clicked_point',
             'parameter_events', 'resets', 'saved_states', 'set_state')
    return [(message.frame, message.topic.rsplit('/', 1)[-1])
            for message in LogReader(run).messages()
            if message.topic.rsplit('/', 1)[-1] in known]


def cdr_uint64(value: int) -> bytes:
    """Return a std_msgs/msg/UInt64."""
    return struct.pack('<4sQ', b'\0\1\0\0', value)


def cdr_string(text: str) -> bytes:
    """Return a std_msgs/msg/String."""
    data = text.encode() + b'\0'
    return struct.pack('<4sI', b'\0\1\0\0', len(data)) + data
