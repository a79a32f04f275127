"""
Poses on a topic of another program, as a source that pins and colliders follow.

A pose in a TF frame other than the scene's is transformed at its stamp, as soon as TF has that
time; until then the last pose before it counts. A pose without a stamp has the time of its
arrival. A trajectory begins when it arrives: linear between its points, and held at its end.

Messages arrive in another thread than lookups, also between two of them.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable

from xpbd_ros.errors import InputError
from xpbd_ros.ros.frame_follower import PoseSource
from xpbd_ros.ros.pose_messages import read_trajectory, Sample, SAMPLES, TRAJECTORY, Trajectory
from xpbd_ros.scene.frames import topic_of_frame
from xpbd_ros.scene.read import unknown
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import compose, interpolated

KEPT = 100
"""poses of a joint that are kept until TF has their time, at most"""

Plan = tuple[int, Trajectory, tuple[Pose, ...]]
"""when a trajectory began [ns], the trajectory, and where its joints were then"""


class TopicPoses:
    """
    A ``PoseSource`` of the poses on one topic.

    Parameters
    ----------
    topic : full name
    frame_id : TF frame of the scene
    transforms : returns the source of TF frames; called with the first pose in another TF frame
    now_ns : clock for messages without a stamp, and for trajectories [ns]

    """

    def __init__(self, topic: str, frame_id: str, transforms: Callable[[], PoseSource],
                 now_ns: Callable[[], int]):
        self.name, self._topic, self._frame_id = topic, topic, frame_id
        self._transforms, self._now_ns = transforms, now_ns
        self._samples: dict[str, tuple[Sample, ...]] = {}    # by joint; replaced as a whole
        self._plan: Plan | None = None

    def take(self, type_name: str, message) -> None:
        """Take a message of one of ``pose_messages.TYPES``."""
        now_ns = self._now_ns()
        if type_name == TRAJECTORY:
            trajectory = read_trajectory(message)
            self._need_transforms(trajectory.frame)
            begin = tuple(self._before(joint, trajectory, now_ns)
                          for joint in trajectory.joints)
            self._plan = now_ns, trajectory, begin
            return
        samples = dict(self._samples)
        for sample in SAMPLES[type_name](message):
            self._need_transforms(sample.frame)
            sample = sample._replace(stamp_ns=sample.stamp_ns or now_ns)
            samples[sample.joint] = (*samples.get(sample.joint, ())[1 - KEPT:], sample)
        self._samples = samples

    def _need_transforms(self, frame: str) -> None:
        """Raise InputError if poses in this TF frame can never be transformed."""
        if frame not in ('', self._frame_id):
            try:
                self._transforms()
            except InputError as error:
                raise InputError(f"TF frame '{frame}' is not the scene's '{self._frame_id}'; "
                                 f'transforming it {error}') from None

    def _before(self, joint: str, new: Trajectory, now_ns: int) -> Pose:
        """Return the pose of a joint when a trajectory arrives: that of the previous one."""
        if self._plan is not None:
            _, old, _ = self._plan
            if joint in old.joints and old.frame == new.frame:
                return planned(self._plan, joint, now_ns)
        return new.poses[0][new.joints.index(joint)]

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the stamp of the latest pose that can be given in the scene's TF frame [ns]."""
        plan, samples = self._plan, self._samples
        joint = self._joint(source, samples if plan is None else plan[1].joints)
        if plan is not None:
            return self._now_ns()
        known_ns: dict[str, int] = {}    # latest time of TF, by TF frame
        for sample in reversed(samples[joint]):
            if sample.frame in ('', self._frame_id):
                return sample.stamp_ns
            if sample.frame not in known_ns:
                known_ns[sample.frame] = self._transforms().latest_ns(self._frame_id,
                                                                      sample.frame)
            if known_ns[sample.frame] == 0 or known_ns[sample.frame] >= sample.stamp_ns:
                return sample.stamp_ns
        raise InputError(f'TF has not the time of {self._topic} yet')

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the pose with a stamp that ``latest_ns`` gave, in the scene's TF frame."""
        plan, samples = self._plan, self._samples
        joint = self._joint(source, samples if plan is None else plan[1].joints)
        if plan is not None:
            return self._to_scene(plan[1].frame, planned(plan, joint, stamp_ns), 0)
        found = next((sample for sample in reversed(samples[joint])
                      if sample.stamp_ns == stamp_ns), None)
        if found is None:
            raise InputError(f'{self._topic}: the pose has been replaced by later ones')
        return self._to_scene(found.frame, found.pose, stamp_ns)

    def _joint(self, source: str, joints: Iterable[str]) -> str:
        """Return the joint of these that a follower's ``frame`` names, or the only one."""
        named, known = topic_of_frame(source), tuple(joints)
        if not known:
            raise InputError(f'no pose on {self._topic}')
        joint = named[1] if named is not None else None
        if joint is None and len(known) == 1:
            return known[0]
        if joint is None:
            raise InputError(f"{self._topic} has several joints; name one with 'joint' "
                             f'({", ".join(known)})')
        if joint not in known:
            raise InputError(f'{self._topic}: {unknown(joint, known, "joint")}')
        return joint

    def _to_scene(self, frame: str, pose: Pose, stamp_ns: int) -> Pose:
        if frame in ('', self._frame_id):
            return pose
        return compose(self._transforms().pose(self._frame_id, frame, stamp_ns), pose)

    def clear(self) -> None:
        """Forget all poses, after the clock went back."""
        self._samples, self._plan = {}, None


def planned(plan: Plan, joint: str, time_ns: int) -> Pose:
    """Return the pose of a joint of a trajectory at a time [ns]."""
    begin_ns, trajectory, begin = plan
    j, times, since_ns = trajectory.joints.index(joint), trajectory.times_ns, time_ns - begin_ns
    k = bisect_right(times, since_ns)
    if k == len(times):
        return trajectory.poses[-1][j]
    before_ns, before = (times[k - 1], trajectory.poses[k - 1][j]) if k else (0, begin[j])
    return interpolated(before, trajectory.poses[k][j],
                        (since_ns - before_ns) / (times[k] - before_ns))
