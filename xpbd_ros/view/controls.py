"""The panel of a page: playback, scenes, colours, live keys, and figures of the run."""

from collections.abc import Collection, Mapping, Sequence
from math import isfinite
from typing import Any, Protocol

from xpbd_ros.sim.commands import Command, SetKey
from xpbd_ros.view.handles import Handles
from xpbd_ros.view.stage import Stage

COLOURS = {
    'none': '',
    'strain': 'strain: red stretched, blue compressed, darkest at 5 %',
    'tension': 'tension: force of the edges, darkest where a twentieth is',
    'contact force': 'contact force: of colliders on a particle, red the largest'}
"""quantities that colour the surface, each with its meaning"""


class Controlled(Protocol):
    """Interface of a view that the panel controls."""

    stage: Stage | None
    handles: Handles

    def play(self, on: bool) -> None:
        """Play or pause."""

    def step_once(self) -> None:
        """Compute one frame while paused."""

    def reset(self) -> None:
        """Go back to the scene's start."""

    def release_all(self) -> None:
        """Release all pins."""

    def record(self, on: bool) -> None:
        """Start or stop recording."""

    def open(self, name: str) -> None:
        """Change to another scene."""

    def put(self, *commands: Command) -> None:
        """Apply commands before the next frame."""


class Controls:
    """
    The panel.

    Parameters
    ----------
    gui : viser's interface for panels
    view : acts on the buttons
    effects : effects of the scene
    keys : (dataclass field, present value) of each live key, as ``scene.model.live_keys`` returns
    colours : words of COLOURS to choose from
    scenes, scene : scenes of the menu, and the present one; no menu without scenes
    contacts : whether the view knows the contacts

    """

    def __init__(self, gui, view: Controlled, *, effects: Collection[str],
                 keys: Mapping[str, tuple[Any, Any]], colours: Sequence[str],
                 scenes: Sequence[str] = (), scene: str = '', contacts: bool = False):
        self._view, self._gui = view, gui
        self._said = ''
        self._boxes: dict[str, Any] = {}
        self._playing = True
        self._play = gui.add_button('Pause')
        self._play.on_click(lambda _: view.play(not self._playing))
        gui.add_button('Step', hint='one frame, while paused').on_click(
            lambda _: view.step_once())
        gui.add_button('Reset', hint="back to the scene's start").on_click(lambda _: view.reset())
        if 'pin' in effects:
            gui.add_button('Release all').on_click(lambda _: view.release_all())
        self._record = gui.add_checkbox('Record', False, hint='to an MCAP log in a new folder')

        @self._record.on_update
        def _(event) -> None:
            if by_hand(event):
                view.record(self._record.value)
        if scenes:
            menu = gui.add_dropdown('Scene', scenes, initial_value=scene)
            menu.on_update(lambda _: view.open(menu.value))
        add_colour_menu(gui, view.stage, colours)
        if contacts and 'contact' in effects:
            touching = gui.add_checkbox('Contacts', False, hint='particles that touch a collider')
            touching.on_update(lambda _: setattr(view.stage, 'contacts', touching.value))
        if 'contact' in effects:
            colliders = gui.add_checkbox('Move colliders', False)
            colliders.on_update(lambda _: view.handles.show_colliders(colliders.value))
        with gui.add_folder('Live keys', expand_by_default=False):
            for key, (field, value) in keys.items():
                self._add_key(key, field, value)
        self._figures = gui.add_markdown('')    # last: lines that come and go move no control

    def _add_key(self, key: str, field, value) -> None:
        about = field.metadata
        hint = f'{about["doc"] or field.name}{" [" + about["unit"] + "]" if about["unit"] else ""}'
        if isinstance(value, tuple | list) and len(value) == 3:
            box = self._gui.add_vector3(key, tuple(map(float, value)), hint=hint)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            least = about['minimum'] if about['above'] is None else about['above']
            bounds = {name: type(value)(bound)
                      for name, bound in (('min', least), ('max', about['maximum']))
                      if bound is not None and isfinite(bound)}
            box = self._gui.add_number(key, value, hint=hint, **bounds)
        else:
            return
        self._boxes[key] = box

        @box.on_update
        def _(event) -> None:
            if by_hand(event):
                new = box.value
                self._view.put(SetKey(key, tuple(map(float, new)) if isinstance(new, tuple)
                                      else new))

    def refresh(self, keys: Mapping[str, tuple[Any, Any]]) -> None:
        """Show the present values of the live keys."""
        for key, (_, value) in keys.items():
            if key in self._boxes:
                value = tuple(map(float, value)) if isinstance(value, tuple | list) else value
                if self._boxes[key].value != value:
                    self._boxes[key].value = value

    def show_playing(self, playing: bool) -> None:
        """Show whether the simulation plays."""
        self._playing = playing
        self._play.label = 'Pause' if playing else 'Play'

    def say(self, text: str) -> None:
        """Show a message below the figures."""
        self._said = text

    def tell(self, rows: Sequence[str]) -> None:
        """Show the figures of the present frame."""
        self._figures.content = '  \n'.join([*rows, *([f'*{self._said}*'] if self._said else [])])


def by_hand(event) -> bool:
    """Return whether a change was made in a browser, and not by this program."""
    return event.client is not None


def add_colour_menu(gui, stage: Stage | None, colours: Sequence[str]) -> None:
    """Add the menu of the quantity that colours the surface."""
    menu = gui.add_dropdown('Colour', colours, initial_value='none',
                            hint='; '.join(filter(None, map(COLOURS.get, colours))))
    menu.on_update(lambda _: setattr(stage, 'colour', menu.value))


def error_text(rms: float, *, resolved: bool, time_s: float) -> str:
    """Return an estimate of a frame's error [m] as text, with the time of the frame [s]."""
    if not resolved:
        return f'under-resolved at {time_s:.2f} s'
    if rms == 0.0:
        return f'none at {time_s:.2f} s, where nothing moved'
    return f'{rms:.2g} m (RMS) at {time_s:.2f} s'
