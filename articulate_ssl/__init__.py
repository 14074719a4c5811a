"""Self-supervised category-level articulated object pose estimation with part-level SE(3) equivariance.

    from articulate_ssl import load
    prediction = load("laptop").predict(points)

`load`, `ArticulatedPoseEstimator`, `ArticulatedPoseModule` and `ScanPrediction` are imported when they are first asked
for, because the networks take seconds to import: docs/python_api.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from articulate_ssl.inference.scan_prediction import ScanPrediction
    from articulate_ssl.pretrained.estimator import ArticulatedPoseEstimator, load
    from articulate_ssl.training.module import ArticulatedPoseModule

__version__ = "0.1.0"
__all__ = ["ArticulatedPoseEstimator", "ArticulatedPoseModule", "ScanPrediction", "load"]

_HOME = {
    "ArticulatedPoseEstimator": "articulate_ssl.pretrained.estimator",
    "ArticulatedPoseModule": "articulate_ssl.training.module",
    "ScanPrediction": "articulate_ssl.inference.scan_prediction",
    "load": "articulate_ssl.pretrained.estimator",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
