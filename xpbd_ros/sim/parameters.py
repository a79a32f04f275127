"""Declaration of effect parameters, and checks that several effects share."""

from dataclasses import field, MISSING
from typing import Any

from xpbd_ros.errors import InputError


def quantity(default: Any = MISSING, *, unit: str = '', above: float | None = None,
             minimum: float | None = None, maximum: float | None = None, live: bool = False,
             choices: tuple[str, ...] = (), doc: str = ''):
    """
    Return a dataclass field that declares a parameter's unit, range and description.

    The scene loader, the table in doc/effects.md and the node's parameter descriptors read it.

    Parameters
    ----------
    default : default value; a parameter without one is required
    unit : such as 'N/m'; empty if dimensionless
    above : exclusive lower bound
    minimum, maximum : inclusive bounds
    live : True if the parameter may change while the simulation runs
    choices : allowed strings
    doc : one-line description

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
    """Raise InputError unless a place is None, a name in PLACES or a non-empty index list."""
    if at is not None and not at:
        raise InputError('at: must name at least one particle')
    if isinstance(at, str) and at not in PLACES:
        raise InputError(f"at: unknown place '{at}' (known: {', '.join(PLACES)}, or a list of "
                         'particle indices)')


def check_frame_name(key: str, frame: str) -> None:
    """Raise InputError if the name of a TF frame begins with a slash, which tf2 refuses."""
    if frame.startswith('/'):
        raise InputError(f"{key}: TF frames have no leading '/'; take '{frame.lstrip('/')}'")


def check_frame(entry) -> None:
    """Raise InputError unless an entry's TF frame, if it names one, goes with its other keys."""
    if entry.frame is None:
        if entry.frame_timeout is not None:
            raise InputError("frame_timeout: needs 'frame', the TF frame to follow")
        return
    check_frame_name('frame', entry.frame)
    if entry.motion is not None:
        raise InputError("needs either 'motion' or 'frame', not both")


def check_static(static: float | None, friction: float) -> None:
    """Raise InputError if static friction is below sliding friction; None means equal."""
    if static is not None and static < friction:
        raise InputError(f'static_friction: must be at least friction ({friction:g}) '
                         f'(got {static:g})')


def along_both(alone: float | None, warp: float | None, weft: float | None
               ) -> tuple[float, float]:
    """Return the values along warp and weft of parameters that ``need_one_or_two`` has checked."""
    if alone is not None:
        return alone, alone
    assert warp is not None and weft is not None
    return warp, weft


def need_one_or_two(alone: float | None, pair: tuple[float | None, float | None], *, either: str,
                    both: str) -> None:
    """
    Raise InputError unless either one common value or a full pair (warp, weft) is given.

    Parameters
    ----------
    alone : value for both directions, or None
    pair : values for warp and weft, each may be None
    either, both : names of the alternatives and of the pair, for the message

    """
    if alone is None and pair == (None, None):
        raise InputError(f'needs either {either}, and has none')
    if alone is not None and pair != (None, None):
        raise InputError(f'needs either {either}, not both')
    if alone is None and None in pair:
        raise InputError(f'needs {both}, and only one of them is given')
