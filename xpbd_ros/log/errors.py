"""The error of an open log."""

from xpbd_ros.errors import InputError


class LogError(InputError):
    """A log cannot be written any further, as on a full disk; what was written stays readable."""
