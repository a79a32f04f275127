"""The types of an effect's data."""

import sys

from xpbd_ros.effects import load
from xpbd_ros.sim.stepping import stages


def kinds_of(name: str) -> set[type]:
    """Return the types for which an effect's file registers kernels."""
    names = vars(sys.modules[load(name).build.__module__])
    return {kind for _, kind in stages.KERNELS if names.get(kind.__name__) is kind}
