"""Scenes that must be refused with a reason, or be repaired with a note."""

from dataclasses import dataclass

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.study.stress.case import Outcome


@dataclass(frozen=True)
class Refusal:
    """A scene that must be refused, or repaired."""

    name: str
    scene: dict
    says: tuple[str, ...]
    """texts that the error must contain"""
    mended: bool = False
    """True if the scene is repaired instead, with these texts in a note"""

    def outcome(self) -> Outcome:
        """Try to compile the scene, and return the result."""
        try:
            simulation = compile_scene(scene_from_mapping(self.scene, where='case', name='case'))
            text = '; '.join(simulation.notes) if self.mended else ''
            why = '' if self.mended else 'was accepted'
        except InputError as error:
            text = str(error)
            why = 'was refused' if self.mended else ''
        missing = [word for word in self.says if word not in text]
        if missing and not why:
            why = f'not in the message: {", ".join(missing)}'
        return Outcome(self.name, not why, reported=text.split(': ', 1)[-1], why=why)
