"""Cloth for robots: an XPBD simulation, and a ROS 2 node that steps it."""

__version__ = '0.1.0'
