"""Honest numbers: calibration on training clouds, per-cloud errors, statistics over instances, reports."""

from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics, cloud_errors
from articulate_ssl.metrics.calibration import Calibration, calibrate

__all__ = ["ArticulatedPoseMetrics", "Calibration", "calibrate", "cloud_errors"]
