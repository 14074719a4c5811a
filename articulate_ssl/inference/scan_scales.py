"""Scans of any unit, origin and number of points: of several scales, the one with the best reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.inference.confidence import relative_error
from articulate_ssl.inference.point_cloud_io import normalise_cloud
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.prediction import ScanEstimate

# Standard deviations, over the training clouds, by which the scale of a scan may differ from their mean.
SCALE_STARTS = (-1.5, -0.75, 0.0, 0.75, 1.5)
_DENSE_POINTS = 4096  # of a scan: as many as a generated cloud has
_SCANS_AT_ONCE = 16  # bounds the memory; each is a cloud per start


def predict_scans(
    estimator: PoseEstimator,
    clouds: Sequence[np.ndarray],  # each [N, 3], any unit, origin and number of points
    num_points: int,
    radius: tuple[float, float],
    refine: bool | None = None,
) -> list[ScanEstimate]:
    """Predict scans of unknown scale: of several within the training clouds' range, the best reconstruction wins.

    `_SCANS_AT_ONCE` go through networks and registration together, and one's prediction does not depend on others.
    What is predicted once more, by all points, takes its proportions then: scales are told apart as well without, but
    where doors may be closed (docs/experiments.md, step 295).

    Args:
        num_points: See `PoseEstimator.predict`; registration reads as many as the options say.
        radius: Mean and standard deviation, over normalised training clouds, of the points' mean distance to their
            centre.
    """
    mean, spread = radius
    starts = [mean + shift * spread for shift in SCALE_STARTS]
    estimates = []
    for first in range(0, len(clouds), _SCANS_AT_ONCE):
        estimates += _predict_together(estimator, clouds[first : first + _SCANS_AT_ONCE], num_points, starts, refine)
    return estimates


def _predict_together(
    estimator: PoseEstimator,
    clouds: Sequence[np.ndarray],  # each [N, 3]
    num_points: int,
    starts: list[float],  # S mean distances to the centre that each is tried with
    refine: bool | None,
) -> list[ScanEstimate]:
    device = estimator.articulated.category.template.device
    centers, scales, tried = [], [], []
    for points in clouds:
        cloud, center, _ = normalise_cloud(points, max(num_points, estimator.inference.points), scale=1.0)
        size = float(np.linalg.norm(np.asarray(points, dtype=np.float64) - center, axis=1).mean())
        centers.append(center)
        scales.append([size / start for start in starts])
        tried += [torch.as_tensor(cloud / scale, dtype=torch.float32) for scale in scales[-1]]
    batch, again = torch.stack(tried).to(device), estimator.reads_dense
    fits = not again or estimator.closed_views.learnt
    if estimator.sliding.learnt:  # which reads all points of a scan
        copies = [_scaled(*scan).to(batch) for scan in zip(clouds, centers, scales, strict=True)]
        both = zip(batch.split(len(starts)), copies, strict=True)
        found = [estimator.predict_with_rivals(some, num_points, refine, dense, fits) for some, dense in both]
    else:
        copies, whole = [None] * len(clouds), estimator.predict_with_rivals(batch, num_points, refine, fits=fits)
        scans = [slice(first, first + len(starts)) for first in range(0, len(batch), len(starts))]
        found = [tuple(one[rows] for one in whole) for rows in scans]
    tried = zip(found, batch.split(len(starts)), copies, centers, scales, strict=True)
    estimates = []
    for points, ((prediction, rival), some, dense, center, scale) in zip(clouds, tried, strict=True):
        best = int(relative_error(prediction, some).argmin())
        own = slice(best, best + 1)
        one, other, some = prediction[own], rival[own], some[own]
        if again:
            dense = _scaled(points, center, scale[own]).to(batch)
            one, other = estimator.predict_with_rivals(some, num_points, refine, dense)
        elif dense is not None:
            dense = dense[own]
        every = dense[0].cpu().numpy() if one.dense_part_id.shape[1] else None
        other = other if one.margin < 1 else None
        estimates.append(ScanEstimate(one, other, some[0].cpu().numpy(), center, scale[best], dense=every))
    return estimates


def _scaled(
    points: np.ndarray,  # [N, 3] of a scan
    center: np.ndarray,  # [3]
    scales: list[float],
) -> Tensor:  # [S, P, 3]
    """At most as many points as a generated cloud has, in several scales; drawn, since their density says something."""
    chosen = np.random.default_rng(0).permutation(len(points))[:_DENSE_POINTS]
    offset = np.asarray(points)[chosen] - center
    return torch.from_numpy(np.stack([offset / scale for scale in scales]))
