"""Joint lines moved to the edges of the part they move.

A small turn about a distant line looks like a large turn about a near one, and descent does not lead from one to the
other.
"""

from __future__ import annotations

import torch

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.geometry.screw import REVOLUTE


def hinged_at_edges(fit: InstanceFit) -> list[InstanceFit]:
    """The fit with each joint line moved to each of the four edges of its part that run along it, states read anew."""
    shape = fit.shape
    joints, others = shape.joints, []
    if joints.joint_type != REVOLUTE:
        return others
    for j, child in enumerate(joints.chain.child):
        points = shape.part(child)
        center = points.mean(dim=0)
        across = torch.linalg.svd(joints.axis[j][None]).Vh[1:]  # [2, 3] a frame of the plane the part turns in
        flat = (points - center) @ across.T
        across = torch.linalg.eigh(flat.T @ flat).eigenvectors.T @ across
        height = (points - center) @ across.T  # [m, 2]
        for u in (height[:, 0].amin(), height[:, 0].amax()):
            for v in (height[:, 1].amin(), height[:, 1].amax()):
                others.append(fit.rehinged(j, center + torch.stack([u, v]) @ across))
    return others
