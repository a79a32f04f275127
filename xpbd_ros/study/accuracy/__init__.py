"""
What accuracy costs in time: a scene under a ladder of settings, each with its error and its time.

``study`` finds errors against a truth (``truth``) in parallel, then times the settings one after
another; ``choose`` marks the Pareto front and recommends a setting.
"""

from xpbd_ros.study.accuracy.measure import Study, study

__all__ = ['Study', 'study']
