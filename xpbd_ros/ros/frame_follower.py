"""
Move the pins and colliders that follow TF frames, by ordinary commands at frame boundaries.

Before each frame, each new transform of a followed TF frame becomes a ``MovePin`` or a
``MoveCollider`` with the transform's stamp. So the motion is interpolated to frame times like any
stream of targets (``sim.target_stream``), and a log repeats it without TF.

A TF frame is silent while its latest transform stays the same; static ones never are. Silence
for longer than ``frame_timeout`` is reported, colliders stay at their last pose, and pins release;
once transforms arrive again, colliders follow, and a pin grasps within its radius. Until its TF
frame is known, a collider is removed and a pin holds where it is. A pin of the scene follows while
it holds nothing too, so that it grasps where its TF frame is.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

from xpbd_ros.errors import InputError
from xpbd_ros.scene.frames import Follower, topic_of_frame
from xpbd_ros.sim.commands import (
    Command,
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    RemoveCollider,
)
from xpbd_ros.sim.geometry.pose import compose
from xpbd_ros.sim.simulation import Simulation


class PoseSource(Protocol):
    """Poses of TF frames: ``ros.tf.Transforms``, the kinematics of a robot, or a topic."""

    name: str
    """in reports: 'TF', or the topic"""

    def latest_ns(self, frame: str, source: str) -> int:
        """Return the time of the latest pose [ns]; 0 for a static one."""

    def pose(self, frame: str, source: str, stamp_ns: int) -> Pose:
        """Return the pose of the TF frame ``source`` in ``frame`` at a time [ns]."""


@dataclass
class Part:
    """One pin or collider, and its state here."""

    about: Follower
    absent: bool = False
    """True of a collider that was removed until its TF frame is known"""
    lost: bool = False
    """True of a pin that was released because its TF frame was silent"""


@dataclass
class Track:
    """One followed TF frame, with the parts that have the same source and timeout."""

    source: PoseSource
    frame: str
    timeout: float
    """[s]"""
    parts: list[Part] = field(default_factory=list)
    pose: Pose | None = None
    """latest pose in the scene's TF frame; None until it is known"""
    stamp_ns: int = 0
    seen_ns: int | None = None
    """time of the latest change, on the follower's clock [ns]"""
    silent: bool = False
    """True if the silence is longer than the timeout, and was reported"""
    reason: str = ''
    """why the latest lookup failed; empty if it did not"""

    def look(self, frame_id: str, now_ns: int) -> bool:
        """Look the TF frame up; return whether there is a new pose."""
        if self.seen_ns is None or self.seen_ns > now_ns:    # or the clock went back
            self.seen_ns = now_ns
        try:
            stamp_ns = self.source.latest_ns(frame_id, self.frame)
            if stamp_ns and stamp_ns == self.stamp_ns:
                self.reason = ''
                return False
            pose = self.source.pose(frame_id, self.frame, stamp_ns)
        except InputError as error:
            self.reason = str(error)
            return False
        new = stamp_ns != self.stamp_ns or pose != self.pose
        self.pose, self.stamp_ns, self.seen_ns, self.reason = pose, stamp_ns, now_ns, ''
        return new

    @property
    def label(self) -> str:
        """Name of the TF frame in reports; of a topic its joint, empty if it has only one."""
        topic = topic_of_frame(self.frame)
        return self.frame if topic is None else topic[1] or ''

    def silence(self, now_ns: int) -> float:
        """Return the time since the latest change [s]."""
        return 0.0 if self.seen_ns is None else max(0.0, 1e-9 * (now_ns - self.seen_ns))


class FrameFollower:
    """
    The followers of one node.

    Parameters
    ----------
    simulation : has the pins and colliders
    frame_id : TF frame of the scene
    sources : each follower with the source of its poses
    now_ns : clock that silence is measured with [ns]
    warn, tell : are given each warning, and each return of a silent TF frame

    """

    def __init__(self, simulation: Simulation, frame_id: str,
                 sources: Iterable[tuple[Follower, PoseSource]], *, now_ns: Callable[[], int],
                 warn: Callable[[str], None], tell: Callable[[str], None]):
        self._simulation, self._frame_id = simulation, frame_id
        self._now_ns, self._warn, self._tell = now_ns, warn, tell
        tracks: dict[tuple, Track] = {}
        for about, source in sources:
            key = id(source), about.frame, about.timeout
            track = tracks.setdefault(key, Track(source, about.frame, about.timeout))
            track.parts.append(Part(about))
        self._tracks = list(tracks.values())
        self._begun = False

    def commands(self, *, reset: bool = False, without: Collection[str] = (),
                 grasped: Collection[str] = ()) -> list[tuple[Command, ...]]:
        """
        Return the commands before the next frame.

        Parameters
        ----------
        reset : whether the scene is reset before that frame
        without : pins that a gripper grasps or releases before that frame
        grasped : pins that other commands grasp before that frame; they follow from then on, also
            if there is no new pose

        """
        if not self._tracks:
            return []
        now_ns = self._now_ns()
        found: list[tuple[Command, ...]] = []
        first, self._begun = not self._begun, True
        changes: dict[str, list[Track]] = {'silent': [], 'back': []}
        for track in self._tracks:
            new = track.look(self._frame_id, now_ns)
            silent = track.silence(now_ns) > track.timeout
            if silent != track.silent:
                track.silent = silent
                changes['silent' if silent else 'back'].append(track)
            for part in track.parts:
                act = self._pin if part.about.section == 'pins' else self._collider
                if reset:
                    part.absent = part.lost = False
                held = part.about.section == 'pins' and part.about.name in grasped
                command = act(part, track, new or reset or held, first or reset, reset)
                if command is not None and part.about.name not in without:
                    found.append((command,))
        self._report(**changes)
        return found

    def _collider(self, part: Part, track: Track, new: bool, first: bool,
                  reset: bool) -> Command | None:
        name = part.about.name
        placed = reset or name in self._built('contact').placed
        if track.pose is None:
            part.absent = part.absent or first and placed
            return RemoveCollider(name) if first and placed else None
        if not new or not (placed or part.absent):
            return None
        part.absent = False
        return MoveCollider(name, compose(track.pose, part.about.offset), None, track.stamp_ns)

    def _pin(self, part: Part, track: Track, new: bool, first: bool,
             reset: bool) -> Command | None:
        about = part.about
        holds = (about.name in self._built('pin').entries if reset
                 else self.holds(about.name))
        if track.pose is None:
            return None
        if track.silent:
            release, part.lost = holds and not part.lost, part.lost or holds
            return Release(about.name) if release else None
        if not new:
            return None
        pose = compose(track.pose, about.offset)
        if part.lost:
            part.lost = False
            if not holds:
                return Grasp(about.name, pose, about.radius)
        can_move = holds or about.name in self._built('pin').entries
        return MovePin(about.name, pose, None, track.stamp_ns) if can_move else None

    def let_go(self, pin: str) -> None:
        """Do not grasp again when a pin's TF frame is back: its gripper is open."""
        for track in self._tracks:
            for part in track.parts:
                if part.about.name == pin and part.about.section == 'pins':
                    part.lost = False

    def holds(self, pin: str) -> bool:
        """Return whether a pin holds particles."""
        return pin in self._built('pin').held

    def _built(self, effect: str) -> Any:
        return self._simulation.effects[effect]

    def _report(self, silent: list[Track], back: list[Track]) -> None:
        """Warn about TF frames that fell silent or returned, in one line for each source."""
        for name, tracks in _by_source(silent):
            unknown = [track for track in tracks if track.pose is None]
            if unknown:
                what = 'transform' if name == 'TF' else 'pose'
                of = f' of {frames}' if (frames := _frames(unknown)) else ''
                self._warn(f'{name}: no {what}{of} in {unknown[0].timeout:g} s: '
                           f'{self._parts(unknown)}; {unknown[0].reason}')
            stale = [track for track in tracks if track.pose is not None]
            if stale:
                reason = next((f'; {track.reason}' for track in stale if track.reason), '')
                self._warn(f'{name}: {_frames(stale, " ")}silent for more than '
                           f'{stale[0].timeout:g} s: {self._parts(stale)}{reason}')
        for name, tracks in _by_source(back):
            self._tell(f'{name}: {_frames(tracks, " ")}back')

    @property
    def finding(self) -> str:
        """Present warning for ``/diagnostics``; empty if no TF frame is silent."""
        silent = [track for track in self._tracks if track.silent]
        return '; '.join(f'{name}: {_frames(tracks, " ")}silent: {self._parts(tracks)}'
                         for name, tracks in _by_source(silent))

    def _parts(self, tracks: list[Track]) -> str:
        """Return the state of the parts of silent TF frames, such as 'collider a held'."""
        return ', '.join(f'{part.about.section.removesuffix("s")} {part.about.name} '
                         f'{self._state(part)}' for track in tracks for part in track.parts)

    def _state(self, part: Part) -> str:
        if part.absent:
            return 'absent'
        if part.lost:
            return 'released'
        held = part.about.section == 'colliders' or self.holds(part.about.name)
        return 'held' if held else 'holds nothing'

    def diagnostics(self) -> dict[str, float]:
        """Return the age of each followed TF frame's latest transform [s]."""
        now_ns = self._now_ns()
        return {f'frame_age_s {track.frame}': track.silence(now_ns) for track in self._tracks}


def _by_source(tracks: list[Track]) -> list[tuple[str, list[Track]]]:
    """Return the tracks of each source, by its name."""
    names = dict.fromkeys(track.source.name for track in tracks)
    return [(name, [track for track in tracks if track.source.name == name]) for name in names]


def _frames(tracks: list[Track], end: str = '') -> str:
    """Return the names of TF frames with ``end`` behind them; nothing if they have none."""
    names = ', '.join(filter(None, (track.label for track in tracks)))
    return names + end if names else ''
