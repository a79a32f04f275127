"""Repeat a recorded run: apply the inputs of its log and compare the states frame by frame."""

from typing import NamedTuple

import numpy as np

from xpbd_ros.ros.logged_commands import Recording
from xpbd_ros.scene.compare import as_text, difference_texts, differences, first_texts, with_solver
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.simulation import Frame, Simulation


class Deviation(NamedTuple):
    """Distances of a frame's particles from their recorded positions."""

    frame: int
    largest: float
    """[m]"""
    rms: float
    """root mean square over the particles [m]"""


class Repeat:
    """
    The comparison of a run with a recorded one.

    States are compared by their hashes, so bit for bit. Deviations in metres come from the
    recorded clouds, which are float32: those below their rounding are 0.

    Parameters
    ----------
    recording : the recorded run
    scene, simulation : the scene of the new run, and its simulation
    frames : last frame that will be stepped

    """

    def __init__(self, recording: Recording, scene: Scene, simulation: Simulation, frames: int):
        self._recording = recording
        self.path = recording.path
        self._simulation = simulation
        self.differences = differences(with_solver(scene, simulation.solver), recording.scene)
        self.compared = 0
        """number of compared frames, the start included"""
        self.missing = 0
        """frames without a hash, because the log is damaged"""
        self.first: int | None = None
        """first frame that differs"""
        self.particle: int | None = None
        """particle with the largest deviation in that frame, in natural order"""
        self.deviation: float | None = 0.0
        """largest deviation of all frames [m]; None if unknown"""
        self.moved: tuple[int, str] | None = None
        """first frame in which a collider is elsewhere, and its name; it may touch nothing"""
        self.track: list[Deviation] = []
        """deviation of each compared frame"""
        self.refused: list[str] = []
        self.notes = recording.inputs_after(frames)
        if frames > recording.last:
            self.notes.append(f'the log ends with frame {recording.last}, and this run with '
                              f'{frames}')
        self._clouds = recording.clouds()
        self._next = next(self._clouds, None)
        self._poses = recording.collider_poses()
        self._colliders = next(self._poses, None)

    def commands(self, index: int) -> list:
        """Return the inputs that act on a frame."""
        return self._recording.commands.get(index, [])

    def look(self, frame: Frame) -> None:
        """Compare the frame just computed with the recorded one."""
        self.refused += [f'frame {frame.index}: {type(command).__name__} is refused: {reason}'
                         for command, reason in frame.refused]
        self._look_at_colliders(frame)
        expected = self._recording.hashes.get(frame.index)
        if expected is None:
            self.missing += frame.index < self._recording.last
            return
        self.compared += 1
        if self._simulation.hash() == expected:
            self.track.append(Deviation(frame.index, 0.0, 0.0))
            return
        apart = self._distances(frame)
        if apart is not None:
            self.track.append(Deviation(frame.index, float(apart.max()),
                                        float(np.sqrt(np.mean(apart**2)))))
        if self.first is None:
            self.first = frame.index
            if apart is not None and apart.any():
                self.particle = int(apart.argmax())
        if apart is None:
            self.deviation = None
        elif self.deviation is not None:
            self.deviation = max(self.deviation, float(apart.max()))

    def _look_at_colliders(self, frame: Frame) -> None:
        """Compare the poses of colliders with the recorded ones."""
        while self._colliders is not None and self._colliders[0] <= frame.index:
            index, poses = self._colliders
            self._colliders = next(self._poses, None)
            if index == frame.index and self.moved is None:
                names = sorted(name for name in poses.keys() | frame.colliders.keys()
                               if name not in poses or name not in frame.colliders
                               or not same_pose(frame.colliders[name].pose, poses[name]))
                if names:
                    self.moved = index, names[0]

    def _distances(self, frame: Frame) -> np.ndarray | None:
        """
        Return the distance of each particle from its recorded position [m], shape (particles,).

        Zero if the log has no cloud of the frame, as with a low publish_rate; None if its clouds
        are of other cloths.
        """
        found = {}
        while self._next is not None and self._next[0] <= frame.index:
            index, topic, places = self._next
            if index == frame.index:
                found[topic] = places
            self._next = next(self._clouds, None)
        if not found:
            return np.zeros(1)
        several = len(self._simulation.cloths) > 1
        apart = []
        for cloth in self._simulation.cloths:
            ending = f'/cloth/{cloth.name}/particles' if several else '/particles'
            there = [places for topic, places in found.items() if topic.endswith(ending)]
            here = frame.x[cloth.particles].astype(np.float32)
            if len(there) != 1 or len(found) != len(self._simulation.cloths) or (
                    there[0].shape != here.shape):
                return None
            apart.append(np.linalg.norm(here.astype(float) - there[0], axis=1))
        return np.concatenate(apart)

    @property
    def identical(self) -> bool:
        """True if scene, inputs and states equal the recorded ones."""
        return not self.problems

    @property
    def problems(self) -> list[str]:
        """Differences from the recording, as texts, in the order in which a run meets them."""
        found = difference_texts(self.differences)
        if self.first is not None:
            where = 'the start' if self.first == 0 else f'frame {self.first}'
            found.append(
                f'differs from the log from {where} on'
                + (f', there most at particle {self.particle}' if self.particle is not None
                   else '')
                + (f', by up to {self.deviation:.3g} m' if self.deviation else ''))
        if self.moved is not None:
            found.append(f"collider '{self.moved[1]}': its pose differs from the log from frame "
                         f'{self.moved[0]} on')
        if self.first is None and not self.compared:
            found.append('no frame could be compared')
        elif self.first is None and self.missing:
            found.append(f'{self.missing} of {self.missing + self.compared} frames have no state '
                         'hash in the log and are not compared')
        return found + first_texts(self.refused, 'refused')

    def numbers(self) -> dict:
        """Return the result as JSON keys."""
        return {
            'log': self._recording.path, 'identical': self.identical, 'frames': self.compared,
            'frames_without_hash': self.missing,
            'first_difference': None if self.first is None else {
                'frame': self.first, 'particle': self.particle},
            'first_collider': None if self.moved is None else {
                'frame': self.moved[0], 'name': self.moved[1]},
            'max_deviation_m': self.deviation,
            'scene': [{'key': key, 'here': as_text(ours), 'log': as_text(theirs)}
                      for key, ours, theirs in self.differences],
            'refused': self.refused, 'notes': self.notes}


def same_pose(one: Pose, other: Pose) -> bool:
    """Return whether two poses are equal bit for bit."""
    return (tuple(one.position) == tuple(other.position)
            and tuple(one.orientation) == tuple(other.orientation))
