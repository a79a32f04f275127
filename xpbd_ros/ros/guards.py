"""Counters of guards: what they count, and in how many frames of a run they were not 0."""

from collections.abc import Mapping

from xpbd_ros.errors import counted

TOTALS = {'frames_taken_back': 'rolled back, not finite or implausible',
          'explicit_redone': 'unstable with explicit, computed again with line'}
"""counters of frames since the start, each with a text about so many frames"""
LOST = {'self_without_room': 'pairs of cloth were left out for lack of room, and may cross; raise '
                             'effects.self_collision.room',
        'contacts_without_room': 'contacts with colliders were left out for lack of room '
                                 '(doc/robustness.md); take fewer colliders, or thinner contact'}
"""counters of a frame that spoil its result, each with a text and the way out"""
IN_FRAME = {**LOST,
            'self_squeezed': 'pairs of cloth that pins or colliders left no room for',
            'contacts_squeezed': 'particles that colliders left no room for',
            'pins_at_max_speed': 'pins lagged behind their targets, held by max_speed',
            'colliders_at_max_speed': 'colliders lagged behind their targets, held by max_speed'}
"""counters of a frame, each with a text"""
GUARDS = (*TOTALS, 'pins_slipped', *IN_FRAME)
"""all counters of guards; each slip of a pin is told on its own, too"""


class Tally:
    """
    The counters of IN_FRAME over the frames of a run.

    Attributes
    ----------
    found : dict
        By counter that was not 0: ``frames`` in which it was not, and the ``largest`` of a frame.

    """

    def __init__(self):
        self.found: dict[str, dict[str, int]] = {}

    def look(self, stats: Mapping[str, float]) -> None:
        """Add the statistics of a frame."""
        for name in IN_FRAME:
            if count := int(stats.get(name, 0)):
                before = self.found.get(name, {'frames': 0, 'largest': 0})
                self.found[name] = {'frames': before['frames'] + 1,
                                    'largest': max(before['largest'], count)}

    def numbers(self, stats: Mapping[str, float]) -> dict[str, object]:
        """Return the totals, from the statistics of the last frame, and ``found``."""
        return {**{name: stats[name] for name in TOTALS if name in stats}, 'guards': self.found}


def texts(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return a line for each counter of a tally, the worst first."""
    return [f"{name}: {IN_FRAME[name]} (in {counted(found[name]['frames'], 'frame')}, at "
            f"most {found[name]['largest']} in one)" for name in IN_FRAME if name in found]
