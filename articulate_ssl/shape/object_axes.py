"""Axes of an object: those of its box."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional
from trimesh.bounds import oriented_bounds_2D

from articulate_ssl.shape.articulated_shape import ArticulatedShape


def object_axes(
    shape: ArticulatedShape,  # with a joint
) -> Tensor:  # [3, 3] columns
    """Of the smallest box about the root that has the first joint's axis for an edge: that axis first.

    Parts of an object that is longer along them still fit together, and turn or slide along the same directions.
    """
    first = functional.normalize(shape.joints.axis[0], dim=0)
    across = torch.linalg.svd(first[None]).Vh[1:]  # [2, 3] at right angles to it
    turn = oriented_bounds_2D((shape.part(shape.joints.chain.root) @ across.T).double().cpu().numpy())[0][:2, :2]
    return torch.cat([first[None], torch.from_numpy(turn).to(across) @ across]).T
