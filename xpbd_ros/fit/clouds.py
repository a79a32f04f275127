"""The point clouds of a recording, at the frames of the simulation that they belong to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sensor_msgs.msg import PointCloud2

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.ros.clouds import points_of
from xpbd_ros.ros.inputs import unpacked
from xpbd_ros.ros.logged_commands import last_part
from xpbd_ros.ros.recorder import type_name
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.effect import Cloth

MOST_CLOUDS, MOST_POINTS = 60, 2000
"""clouds of a recording, and points of a cloud, that a fit uses; evenly spread"""
MOST_APART = 10.0
"""between the stamp and the log time of a cloud [s]; a stamp in the future is simulated up to"""


@dataclass(frozen=True)
class Cloud:
    """The measured points of a cloth at the end of a frame."""

    frame: int
    cloth: int
    """number of the cloth in the simulation"""
    points: np.ndarray
    """[m], shape (points, 3)"""
    particles: np.ndarray | None
    """particle of each point, shape (points,); None for points anywhere on the cloth"""


def read_clouds(log: str, scene: Scene, cloths: Sequence[Cloth], *, topic: str | None,
                start: float, duration: float | None) -> list[Cloud]:
    """
    Return the clouds of a recording.

    An organised cloud with as many points as the cloth has particles is compared particle by
    particle; NaN marks missing points. Any other is compared with the surface.

    Parameters
    ----------
    log : a folder or an .mcap file
    scene, cloths : the scene and its cloths
    topic : of the clouds; None for all named ``particles``, or the only one
    start : time in the recording at which the scene starts [s]
    duration : of the scene, beyond which clouds are left out [s]; None for all

    Raises
    ------
    InputError : no such topic, a cloud in another TF frame or of another clock, none after the
                 start, or points of the surface of a cloth without triangles

    """
    reader = LogReader(log)
    topics = _topics(reader, topic, cloths)
    begin = (reader.start_ns or 0) + round(1e9 * start)
    rate, found = scene.top.frame_rate, []
    for message in reader.messages(topics):
        cloud, cloth = unpacked(message.data, PointCloud2), topics[message.topic]
        stamp = 10**9 * cloud.header.stamp.sec + cloud.header.stamp.nanosec
        if stamp and (apart := 1e-9 * abs(message.time_ns - stamp)) > MOST_APART:
            raise InputError(f"{reader.path}: {message.topic}: stamp and log time of a cloud are "
                             f"{apart:.3g} s apart, so they are of two clocks; for stamps in "
                             "simulation time, record with 'ros2 bag record --use-sim-time'")
        time = 1e-9 * ((stamp or message.time_ns) - begin)
        frame = round(time * rate)
        if frame < 1 or duration is not None and frame > round(duration * rate):
            continue
        if cloud.header.frame_id not in ('', scene.top.frame_id):
            raise InputError(f"{reader.path}: {message.topic}: is in the TF frame "
                             f"'{cloud.header.frame_id}', and the scene in "
                             f"'{scene.top.frame_id}'; transform the cloud first")
        try:
            points = points_of(cloud).reshape(-1, 3)
        except InputError as error:
            raise InputError(f'{reader.path}: {message.topic}: {error}') from None
        mesh = cloths[cloth].mesh
        particles = np.arange(len(points)) if len(points) == len(mesh.positions) else None
        there = np.flatnonzero(np.isfinite(points).all(1))
        if particles is None:
            if not len(mesh.triangles):
                raise InputError(f'{reader.path}: {message.topic}: {len(points)} points are not '
                                 f"the {len(mesh.positions)} particles of '{cloths[cloth].name}', "
                                 'which has no triangles')
            there = _spread(there, MOST_POINTS)
        if len(there):
            found.append(Cloud(frame, cloth, points[there],
                               None if particles is None else particles[there]))
    if not found:
        raise InputError(f'{reader.path}: holds no cloud after its start on {", ".join(topics)}')
    return [found[k] for k in _spread(np.arange(len(found)), MOST_CLOUDS)]


def _topics(reader: LogReader, topic: str | None, cloths: Sequence[Cloth]) -> dict[str, int]:
    """Return the topics of clouds, each with the number of its cloth."""
    clouds = [name for name, about in reader.topics.items()
              if about.type == type_name(PointCloud2)]
    if topic is not None:
        if topic not in clouds:
            raise InputError(f'--cloud {topic}: {reader.path} holds no such point cloud (known: '
                             f'{", ".join(clouds) or "none"})')
        chosen = [topic]
    else:
        chosen = [name for name in clouds if last_part(name) == 'particles'] or clouds
    if not chosen:
        raise InputError(f'{reader.path}: holds no point cloud (sensor_msgs/msg/PointCloud2)')
    names = [cloth.name for cloth in cloths]
    found = {}
    for name in chosen:
        cloth = name.split('/')[-2] if name.count('/') > 1 else ''
        if len(cloths) > 1 and cloth not in names:
            raise InputError(f'{reader.path}: {name}: of which cloth? With several the topic must '
                             f'be …/NAME/particles (cloths: {", ".join(names)})')
        found[name] = names.index(cloth) if cloth in names else 0
    if len(found) > len(cloths):
        raise InputError(f'{reader.path}: holds several point clouds; choose one by --cloud '
                         f'({", ".join(found)})')
    return found


def _spread(items: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many items, evenly spread, the last one included."""
    if len(items) <= most:
        return items
    return items[np.linspace(len(items) / most - 1, len(items) - 1, most).round().astype(int)]
