"""Predict stiffness, damping, substeps and time of a scene with its solver setting."""

from xpbd_ros.study.prediction.report import check, Report

__all__ = ['check', 'Report']
