"""Keys of a scene's ``pins``."""

from dataclasses import dataclass

from xpbd_ros.errors import InputError
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.parameters import check_frame, check_place, quantity
from xpbd_ros.sim.target_motion import check_motion


@dataclass(frozen=True)
class Entry:
    """One entry of the scene's ``pins``: a pin that holds cloth from the start."""

    cloth: str = quantity(doc='the cloth that it holds')
    at: str | tuple[int, ...] | None = quantity(
        None, doc='corner_00 …, edge_0x …, or numbers of particles')
    near: tuple[float, float, float] | None = quantity(
        None, unit='m', doc='point around which it holds')
    radius: float = quantity(0.01, unit='m', above=0.0, doc='radius around that point')
    target: tuple[float, float, float] | None = quantity(
        None, unit='m', doc='where it moves to, at max_speed')
    motion: tuple[tuple[float, ...], ...] | None = quantity(
        None, unit='s, m', doc='points [t, x, y, z] that it passes, joined by monotone cubics; at '
        'rest before the first and after the last')
    frame: str | None = quantity(None, doc='TF frame that it follows')
    position: tuple[float, float, float] | None = quantity(None, unit='m',
                                                           doc='offset in that frame')
    orientation: tuple[float, float, float, float] | None = quantity(
        None, doc='offset in that frame, a quaternion x y z w')
    frame_timeout: float | None = quantity(None, unit='s', above=0.0, doc=(
        'silence of the frame after which it releases; 1 s unless given'))
    max_speed: float = quantity(5.0, unit='m/s', above=0.0, doc='largest speed of the pin')
    compliance: float | None = quantity(None, unit='m/N', minimum=0.0,
                                        doc='compliance of the whole pin; 0 is rigid')
    slip: float | None = quantity(None, unit='N', above=0.0, doc='force at which it releases')

    def __post_init__(self):
        """Require one of ``at`` and ``near``, and at most one of ``target`` and ``motion``."""
        if (self.at is None) == (self.near is None):
            raise InputError("needs either 'at' or 'near', and only one of them")
        check_place(self.at)
        if self.target is not None and self.motion is not None:
            raise InputError("needs either 'target' or 'motion', not both")
        check_motion(self.motion)
        check_frame(self)
        if self.frame is not None and self.target is not None:
            raise InputError("needs either 'target' or 'frame', not both")
        if self.frame is None and (self.position or self.orientation):
            raise InputError("position and orientation: need 'frame', the TF frame to follow")

    @property
    def offset(self) -> Pose:
        """Its pose in the TF frame that it follows."""
        return Pose(self.position or (0.0, 0.0, 0.0), self.orientation or (0.0, 0.0, 0.0, 1.0))
