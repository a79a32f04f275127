"""What must be refused before anything runs, with its reason, or be mended and said."""

from dataclasses import dataclass

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.study.stress.case import Outcome


@dataclass(frozen=True)
class Refusal:
    """A scene that must not be accepted."""

    name: str
    scene: dict
    says: tuple[str, ...]
    """texts of the one line that refuses it"""
    mended: bool = False
    """whether it is accepted instead, and the same is said in a note"""

    def outcome(self) -> Outcome:
        """Try to load it."""
        try:
            simulation = compile_scene(scene_from_mapping(self.scene, where='case', name='case'))
            text = '; '.join(simulation.notes) if self.mended else ''
            why = '' if self.mended else 'was accepted'
        except InputError as error:
            text = str(error)
            why = 'was refused' if self.mended else ''
        missing = [word for word in self.says if word not in text]
        if missing and not why:
            why = f'did not say: {", ".join(missing)}'
        return Outcome(self.name, not why, reported=text.split(': ', 1)[-1], why=why)
