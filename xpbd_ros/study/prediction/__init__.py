"""What a scene will be like at its setting, predicted before anything runs."""

from xpbd_ros.study.prediction.report import check, Report

__all__ = ['check', 'Report']
