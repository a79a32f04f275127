"""
Error against time: run a scene with many solver settings, and measure error and time of each.

``study`` computes errors against a true solution (``truth``) in parallel, then times the settings
one after another; ``choose`` marks the Pareto front and recommends a setting.
"""

from xpbd_ros.study.accuracy.measure import Study, study

__all__ = ['Study', 'study']
