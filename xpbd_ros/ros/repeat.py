"""A run that takes the inputs of a log, and is compared with it frame by frame."""

import numpy as np

from xpbd_ros.ros.logged_commands import Recording
from xpbd_ros.scene.compare import as_text, differences, first_of, told, with_solver
from xpbd_ros.scene.model import Scene
from xpbd_ros.sim.simulation import Frame, Simulation


class Repeat:
    """
    The comparison of a run with a recorded one.

    States are compared by their hashes, so bit for bit. How far they are apart is taken from the
    recorded clouds, which are float32: deviations below their rounding are 0.

    Parameters
    ----------
    recording : what is repeated
    scene, simulation : with what
    frames : how many will be stepped

    """

    def __init__(self, recording: Recording, scene: Scene, simulation: Simulation, frames: int):
        self._recording = recording
        self._simulation = simulation
        self.differences = differences(with_solver(scene, simulation.solver), recording.scene)
        self.compared = 0
        """frames, the start among them"""
        self.missing = 0
        """frames whose hash a damaged log has lost"""
        self.first: int | None = None
        """frame from which on they differ"""
        self.particle: int | None = None
        """the one that is furthest off in that frame, in natural order"""
        self.deviation: float | None = 0.0
        """largest [m]; None if it is not known"""
        self.refused: list[str] = []
        self.notes = recording.beyond(frames)
        if frames > recording.last:
            self.notes.append(f'the log ends with frame {recording.last}, and this run with '
                              f'{frames}')
        self._clouds = recording.clouds()
        self._next = next(self._clouds, None)

    def commands(self, index: int) -> list:
        """Return the inputs that act on a frame."""
        return self._recording.commands.get(index, [])

    def look(self, frame: Frame) -> None:
        """Compare a frame, which was just computed, with the recorded one."""
        self.refused += [f'frame {frame.index}: {type(command).__name__} is refused: {reason}'
                         for command, reason in frame.refused]
        expected = self._recording.hashes.get(frame.index)
        if expected is None:
            self.missing += frame.index < self._recording.last
            return
        self.compared += 1
        if self._simulation.hash() == expected:
            return
        apart = self._apart(frame)
        if self.first is None:
            self.first = frame.index
            if apart is not None and apart.any():
                self.particle = int(apart.argmax())
        if apart is None:
            self.deviation = None
        elif self.deviation is not None:
            self.deviation = max(self.deviation, float(apart.max()))

    def _apart(self, frame: Frame) -> np.ndarray | None:
        """
        Return how far each particle is from where it was recorded [m].

        Zeros where the frame has no cloud, as with a low publish_rate; None for another cloth.
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
        """Whether all was as recorded."""
        return not self.problems

    @property
    def problems(self) -> list[str]:
        """What was not as recorded, in words; what comes first in a run stands first."""
        found = told(self.differences)
        if self.first is not None:
            where = 'the start' if self.first == 0 else f'frame {self.first}'
            found.append(
                f'differs from the log from {where} on'
                + (f', there most at particle {self.particle}' if self.particle is not None
                   else '')
                + (f', by up to {self.deviation:.3g} m' if self.deviation else ''))
        elif not self.compared:
            found.append('no frame could be compared')
        elif self.missing:
            found.append(f'{self.missing} of {self.missing + self.compared} frames have no state '
                         'hash in the log and are not compared')
        return found + first_of(self.refused, 'inputs are refused')

    def numbers(self) -> dict:
        """Return the same for a program."""
        return {
            'log': self._recording.path, 'identical': self.identical, 'frames': self.compared,
            'frames_without_hash': self.missing,
            'first_difference': None if self.first is None else {
                'frame': self.first, 'particle': self.particle},
            'max_deviation_m': self.deviation,
            'scene': [{'key': key, 'here': as_text(ours), 'log': as_text(theirs)}
                      for key, ours, theirs in self.differences],
            'refused': self.refused, 'notes': self.notes}
