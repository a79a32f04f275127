"""Parameters of effects: how they are declared, and checks that several effects share."""

from dataclasses import field, MISSING
from typing import Any

from xpbd_ros.errors import InputError


def quantity(default: Any = MISSING, *, unit: str = '', above: float | None = None,
             minimum: float | None = None, maximum: float | None = None, live: bool = False,
             choices: tuple[str, ...] = (), doc: str = ''):
    """
    Declare a parameter: its unit, its range and whether it may change while running.

    ``above`` is an exclusive lower bound. The loader, the table in doc/effects.md and the node's
    parameter descriptors all read this.
    """
    metadata = {'unit': unit, 'above': above, 'minimum': minimum, 'maximum': maximum,
                'live': live, 'choices': choices, 'doc': doc}
    if default is MISSING:
        return field(metadata=metadata)
    if isinstance(default, dict | list):
        return field(default_factory=lambda: type(default)(default), metadata=metadata)
    return field(default=default, metadata=metadata)


PLACES = ('corner_00', 'corner_01', 'corner_10', 'corner_11',
          'edge_0x', 'edge_1x', 'edge_x0', 'edge_x1')


def check_place(at: str | tuple[int, ...] | None) -> None:
    """Refuse a place that no cloth has."""
    if at is not None and not at:
        raise InputError('at: must name at least one particle')
    if isinstance(at, str) and at not in PLACES:
        raise InputError(f"at: unknown place '{at}' (known: {', '.join(PLACES)}, or a list of "
                         'particle indices)')


def check_static(static: float | None, friction: float) -> None:
    """Refuse what slides harder than it sticks."""
    if static is not None and static < friction:
        raise InputError(f'static_friction: must be at least friction ({friction:g}) '
                         f'(got {static:g})')


def need_one_or_two(alone: float | None, pair: tuple[float | None, float | None], *, either: str,
                    both: str) -> None:
    """Refuse a value for all together with those of warp and weft, neither, and half of a pair."""
    if (alone is None) == (pair == (None, None)):
        raise InputError(f'needs either {either}, not both')
    if alone is None and None in pair:
        raise InputError(f'needs {both}, and only one of them is given')
