"""What can go wrong with a log once it is open."""

from xpbd_ros.errors import InputError


class LogError(InputError):
    """A log that cannot be written any further, say on a full disk; what it holds stays."""
