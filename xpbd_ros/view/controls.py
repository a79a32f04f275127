"""The panel of a live page: playback, scenes, live keys, and figures of the run."""

from collections import deque
from math import isfinite

from numpy.linalg import norm

from xpbd_ros.scene.model import live_keys
from xpbd_ros.sim.commands import SetKey

RECENT = 60
"""frames that the step time is averaged over"""


class Controls:
    """
    The panel.

    Parameters
    ----------
    gui : viser's interface for panels
    view : ``LiveView`` that the buttons act on
    names : scenes of the menu

    """

    def __init__(self, gui, view, names: list[str]):
        self._view, self._gui = view, gui
        self._step_s: deque[float] = deque(maxlen=RECENT)
        self._said = ''
        self._figures = gui.add_markdown('')
        self._play = gui.add_button('Pause' if view.playing else 'Play')
        self._play.on_click(lambda _: self._toggle())
        gui.add_button('Step', hint='one frame, while paused').on_click(
            lambda _: view.step_once())
        gui.add_button('Reset', hint="back to the scene's start").on_click(lambda _: view.reset())
        if 'pin' in view.simulation.effects:
            gui.add_button('Release all').on_click(lambda _: view.release_all())
        record = gui.add_checkbox('Record', False, hint='to an MCAP log in a new folder')
        record.on_update(lambda _: view.record(record.value))
        menu = gui.add_dropdown('Scene', names, initial_value=view.name)
        menu.on_update(lambda _: view.open(menu.value))
        strain = gui.add_checkbox('Strain', False, hint='edges: red stretched, blue compressed')
        strain.on_update(lambda _: setattr(view.stage, 'strain', strain.value))
        self._colliders = None
        if 'contact' in view.simulation.effects:
            self._colliders = gui.add_checkbox('Move colliders', False)
            self._colliders.on_update(
                lambda _: view.show_collider_handles(self.shows_colliders))
        with gui.add_folder('Live keys', expand_by_default=False):
            for key, (field, value) in live_keys(view.scene).items():
                self._add_key(key, field, value)

    def _add_key(self, key: str, field, value) -> None:
        about = field.metadata
        hint = f'{about["doc"] or field.name}{" [" + about["unit"] + "]" if about["unit"] else ""}'
        if isinstance(value, tuple) and len(value) == 3:
            box = self._gui.add_vector3(key, tuple(map(float, value)), hint=hint)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            least = about['minimum'] if about['above'] is None else about['above']
            bounds = {name: type(value)(bound)
                      for name, bound in (('min', least), ('max', about['maximum']))
                      if bound is not None and isfinite(bound)}
            box = self._gui.add_number(key, value, hint=hint, **bounds)
        else:
            return

        @box.on_update
        def _(_) -> None:
            new = box.value
            self._view.put(SetKey(key, tuple(new) if isinstance(value, tuple) else new))

    @property
    def shows_colliders(self) -> bool:
        """True if colliders have gizmos."""
        return self._colliders is not None and self._colliders.value

    def _toggle(self) -> None:
        self._view.playing = not self._view.playing
        self._play.label = 'Pause' if self._view.playing else 'Play'

    def time(self, seconds: float) -> None:
        """Note the time of a step [s]."""
        self._step_s.append(seconds)

    def say(self, text: str) -> None:
        """Show a message below the figures."""
        self._said = text

    def tell(self, frame, strain: float, *, recording: bool) -> None:
        """Show the figures of the present frame."""
        step = sum(self._step_s) / max(1, len(self._step_s))
        factor = self._view.simulation.frame_dt / step if step else 0.0
        rows = [f'**{1e-9 * frame.time_ns:.2f} s**, {len(frame.x)} particles'
                + (', recording' if recording else ''),
                f'step {1e3 * step:.2f} ms: {factor:.1f} × real time',
                f'largest strain {100.0 * strain:.2g} %',
                *(f'{name}: {norm(pin.force):.3g} N at '
                  f'{", ".join(f"{c:.2f}" for c in pin.pose.position)} m'
                  for name, pin in frame.pins.items())]
        self._figures.content = '  \n'.join([*rows, *([f'*{self._said}*'] if self._said else [])])
