"""A pytest plugin that turns one effect off: it is there, and none of its kernels runs."""

import os

from support.kinds import kinds_of
from xpbd_ros.sim.stepping import stages


def pytest_configure(config):
    """Take the kernels of the effect XPBD_ROS_OFF out of all stages."""
    kinds = kinds_of(os.environ['XPBD_ROS_OFF'])
    for key in [key for key in stages.KERNELS if key[1] in kinds]:
        del stages.KERNELS[key]
