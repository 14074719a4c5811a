"""From normalised part coordinates to poses: RANSAC with Procrustes per part.

Nothing here learns. Part coordinates (NPCS) are rest-state coordinates about the part's bounding-box centre, in the
object's axes and the cloud's unit: clouds are normalised already, so a part's pose is rigid (paper, appendix "NPCS").
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.shape.part_poses import rigid_fit

HYPOTHESES = 64  # of RANSAC; a third of outliers leaves one in three of them clean
SAMPLE_POINTS = 4  # of each: three fix a pose, a fourth damps noise
INLIER_DISTANCE = 0.05  # cloud units, as the metrics' calibration has it
REFINEMENTS = 3  # Procrustes fits to the inliers of the one before
_SEED = 0


def ransac_poses(
    coordinates: Tensor,  # [B, K, N, 3] of every point in every part's space
    points: Tensor,  # [B, N, 3]
    weight: Tensor,  # [B, K, N] in [0, 1], how much each point belongs to each part
) -> Tensor:  # [B, K, 4, 4]
    """Pose of every part, part space -> camera space: most weight within `INLIER_DISTANCE`, then fits to the inliers.

    Draws are the same every time. A part of fewer than `SAMPLE_POINTS` is fitted to all points.
    """
    _, K, N, _ = coordinates.shape
    target = points[:, None].expand(-1, K, -1, -1)
    weight = torch.where(weight.sum(-1, keepdim=True) >= SAMPLE_POINTS, weight, 1.0) + 1e-9
    generator = torch.Generator().manual_seed(_SEED)
    # Weighted draws without replacement, as the largest of u^(1/w) (Efraimidis and Spirakis 2006).
    uniform = torch.rand(HYPOTHESES, N, generator=generator).to(points).clamp(min=1e-12)
    keys = uniform.log() / weight[:, :, None].clamp(min=1e-6)  # [B, K, H, N]
    chosen = keys.topk(min(SAMPLE_POINTS, N), dim=-1).indices.flatten(2)[..., None].expand(-1, -1, -1, 3)
    few = [x.gather(2, chosen).unflatten(2, (HYPOTHESES, -1)) for x in (coordinates, target)]
    pose = rigid_fit(*few, torch.ones_like(few[0][..., 0]))  # [B, K, H, 4, 4]
    distance = (transform_points(pose, coordinates[:, :, None]) - target[:, :, None]).norm(dim=-1)
    inliers = ((distance < INLIER_DISTANCE) * weight[:, :, None]).sum(-1)  # [B, K, H]
    best = inliers.argmax(-1)[..., None, None, None].expand(-1, -1, -1, 4, 4)
    pose = pose.gather(2, best).squeeze(2)
    for _ in range(REFINEMENTS):
        distance = (transform_points(pose, coordinates) - target).norm(dim=-1)
        # Where nothing is near, the pose stays undecided: then all points count, so that it stays finite.
        near = (distance < INLIER_DISTANCE) * weight
        pose = rigid_fit(coordinates, target, torch.where(near.sum(-1, keepdim=True) > 1e-6, near, weight))
    return pose
