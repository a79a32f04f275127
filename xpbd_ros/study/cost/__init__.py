"""What each effect of a scene costs: in time, in memory and in code."""

from xpbd_ros.study.cost.measure import Cost, cost, Row

__all__ = ['Cost', 'cost', 'Row']
