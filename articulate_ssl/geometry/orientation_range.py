"""How far the objects of a category are turned: any way, or within a range of their mean orientation.

A depth camera that is held upright sees objects from a range of sides. Which way up they are is then known, and which
of two like plates is the lid of a laptop, though the camera sees the thickness of neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class OrientationRange:
    """Rotations about the identity, which is the objects' mean orientation wherever the range is limited.

    Attributes:
        degrees: Largest angle; 180 allows every rotation.

    Raises:
        ValueError: if the angle is not in (0, 180].
    """

    degrees: float = 180.0

    def __post_init__(self) -> None:
        if not 0 < self.degrees <= 180:
            raise ValueError(f"orientation_range is an angle in (0, 180] degrees, got {self.degrees}")

    @property
    def limited(self) -> bool:
        """Whether some rotation is excluded."""
        return self.degrees < 180

    def contains(
        self,
        rotation: Tensor,  # [..., 3, 3]
    ) -> Tensor:  # [...] bool
        """Whether rotations are within the range."""
        if not self.limited:
            return torch.ones(rotation.shape[:-2], dtype=torch.bool, device=rotation.device)
        identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device).expand_as(rotation)
        return roma.rotmat_geodesic_distance(rotation, identity).rad2deg() <= self.degrees

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Random rotations [count, 3, 3] within the range; uniform if it is not limited, nearly so if it is small."""
        quaternion = functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
        if not self.limited:
            return roma.unitquat_to_rotmat(quaternion)
        angle = torch.rand(count, 1, generator=generator).pow(1 / 3).mul(self.degrees).deg2rad()
        return roma.rotvec_to_rotmat(angle * functional.normalize(quaternion[:, :3], dim=-1))


def mean_rotation(
    rotation: Tensor,  # [n, 3, 3]
) -> Tensor:  # [3, 3]
    """The rotation nearest to the mean of the matrices (chordal mean)."""
    return roma.special_procrustes(rotation.mean(dim=0))
