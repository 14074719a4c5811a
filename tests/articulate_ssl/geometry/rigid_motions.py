"""Poses and directions for tests."""

from __future__ import annotations

import roma
import torch

from articulate_ssl.geometry.se3 import se3

DTYPE = torch.float64


def random_pose(*batch: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(*batch, 4, dtype=DTYPE, generator=generator)
    rotation = roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))
    return se3(rotation, torch.randn(*batch, 3, dtype=DTYPE, generator=generator))


def unit(*values: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(values, dtype=DTYPE), dim=-1)
