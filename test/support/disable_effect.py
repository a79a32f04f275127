"""A pytest plugin that turns one effect off: it is there, and none of its kernels runs."""

import os

from xpbd_ros.effects import load
from xpbd_ros.sim.stepping import stages


def pytest_configure(config):
    """Take the kernels of the effect XPBD_ROS_OFF out of all stages."""
    module = load(os.environ['XPBD_ROS_OFF']).build.__module__
    for key in [key for key in stages._KERNELS if key[1].__module__ == module]:
        del stages._KERNELS[key]
