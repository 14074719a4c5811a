"""A joint from how one part moves relative to another: a robust fit of a screw motion to many relative poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import roma
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC, screw_motion

_OUTLIER = 0.02  # distances beyond this, in normalised units, count linearly instead of squared


class ScrewFit(NamedTuple):
    """n relative poses as screw(axis, pivot, state) @ mean.

    Attributes:
        axis: [3] unit.
        pivot: [3] of a revolute joint; zero of a prismatic one.
        state: [n] with median zero.
        mean: [4, 4] the relative pose at state zero.
        gap: [n] root mean square distance that remains between where the two take the part's points.
    """

    axis: Tensor
    pivot: Tensor
    state: Tensor
    mean: Tensor
    gap: Tensor


def fit_screw(
    relative: Tensor,  # [n, 4, 4] moving part -> other part
    points: Tensor,  # [m, 3] of the moving part
    joint_type: int,
) -> ScrewFit:
    """Fit to where the poses take the part's points.

    Not to their rotations: how far a thin rod has turned about its own length moves no point and is not observable.
    Clouds that were registered wrongly count little.
    """
    moments = _moments(points.double().cpu().numpy())
    pose = relative.double().cpu().numpy()
    moved = np.einsum("nij,mj->nmi", pose[:, :3, :3], moments) + pose[:, None, :3, 3]
    mean = np.eye(4)
    mean[:3, :3] = roma.special_procrustes(relative[:, :3, :3].double().cpu().mean(dim=0)).numpy()
    mean[:3, 3] = np.median(moved.mean(axis=1), axis=0) - mean[:3, :3] @ moments.mean(axis=0)
    # A joint moves every point along a line, or within a plane across its axis.
    scatter = (moved - np.median(moved, axis=0)).reshape(-1, 3)
    directions = np.linalg.eigh(scatter.T @ scatter)[1]
    if joint_type == PRISMATIC:
        starts = [directions[:, -1]]
    else:
        turn = Rotation.from_matrix(pose[:, :3, :3] @ mean[:3, :3].T).as_rotvec()
        starts = [directions[:, 0], np.linalg.eigh(turn.T @ turn)[1][:, -1]]
    fits = [_refine(moved, moments, mean, axis, joint_type) for axis in starts]
    axis, pivot, state, mean, gap = (
        torch.as_tensor(value).to(relative) for value in min(fits, key=lambda fit: np.median(fit[-1]))
    )
    middle = state.median()
    return ScrewFit(axis, pivot, state - middle, screw_motion(axis, pivot, middle, joint_type) @ mean, gap)


def _moments(points: np.ndarray) -> np.ndarray:
    """[6, 3] points with the first two moments of [m, 3]: sums of squares of affine maps depend on nothing else."""
    center = points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    offsets = np.sqrt(3 * variance.clip(min=0))[:, None] * axes.T
    return np.concatenate([center + offsets, center - offsets])


def _refine(moved: np.ndarray, moments: np.ndarray, mean: np.ndarray, axis: np.ndarray, joint_type: int) -> tuple:
    """Axis, pivot and mean pose by robust least squares; the state of every pose follows from them in closed form."""
    center = moved.mean(axis=(0, 1))

    def unpack(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(z[6:9]).as_matrix() @ mean[:3, :3]
        pose[:3, 3] = mean[:3, 3] + z[9:12]
        return z[:3] / np.linalg.norm(z[:3]), center + z[3:6], pose

    def predict(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, p, pose = unpack(z)
        rest = moments @ pose[:3, :3].T + pose[:3, 3]
        if joint_type == PRISMATIC:
            state = (moved - rest).mean(axis=1) @ a
            return state, rest + state[:, None, None] * a
        x, y = rest - p, moved - p
        along = x @ a
        flat, side = x - along[:, None] * a, np.cross(a, x)
        state = np.arctan2(np.einsum("mi,nmi->n", side, y), np.einsum("mi,nmi->n", flat, y))
        cos, sin = np.cos(state)[:, None, None], np.sin(state)[:, None, None]
        return state, p + along[:, None] * a + cos * flat + sin * side

    def residual(z: np.ndarray) -> np.ndarray:
        # The ridge holds what the poses leave free: a pivot along its axis, the mean pose along the motion.
        return np.concatenate([(predict(z)[1] - moved).ravel(), 1e-3 * (z - start)])

    start = np.concatenate([axis, np.zeros(9)])
    z = least_squares(residual, start, loss="soft_l1", f_scale=_OUTLIER, max_nfev=50).x
    a, p, pose = unpack(z)
    state, predicted = predict(z)
    gap = np.sqrt(np.square(predicted - moved).sum(axis=-1).mean(axis=-1))
    return a, np.zeros(3) if joint_type == PRISMATIC else p, state, pose, gap
