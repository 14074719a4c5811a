"""SO(3)-PointNet: group-indexed features of whole parts, and attention pooling over the group (paper, Sec. 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SO3PointNet(nn.Module):
    """Part features from point features: a perceptron on (feature, A_g^T x), then a maximum over a part's points.

    Output channel (k, g) is the response of part k to the cloud as seen from group element g, so rotating the cloud by
    a group element permutes g, like the backbone's features.
    """

    def __init__(self, in_dim: int, out_dim: int, elements: Tensor) -> None:
        """Args: input and output channels; `elements` [G, 3, 3], the group's rotation matrices."""
        super().__init__()
        self.register_buffer("elements", elements, persistent=False)
        self.perceptron = nn.Sequential(
            nn.Linear(in_dim + 3, out_dim),
            nn.LayerNorm(out_dim),
            nn.LeakyReLU(0.1),
            nn.Linear(out_dim, out_dim),
            nn.ReLU(),
        )

    def forward(
        self,
        features: Tensor,  # [B, M, G, C]
        points: Tensor,  # [B, M, 3], in the frame the features were computed in
        association: Tensor,  # [B, M, K], how much each point belongs to each part
    ) -> Tensor:  # [B, K, G, C']
        """Pool points into parts; a point of association zero cannot raise the maximum (features are non-negative)."""
        local = torch.einsum("bmi,gij->bmgj", points, self.elements.to(points.dtype))
        hidden = self.perceptron(torch.cat([features, local.to(features.dtype)], dim=-1))
        return torch.stack([(hidden * w[..., None, None]).amax(dim=1) for w in association.unbind(-1)], dim=1)


class GroupAttentionPooling(nn.Module):
    """Invariant features: a softmax over the group, one logit per group element (paper: attention pooling)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.logit = nn.Linear(dim, 1)

    def forward(self, features: Tensor) -> Tensor:
        """[..., G, C] -> [..., C]; unchanged when the group index is permuted."""
        return (features * self.logit(features).softmax(dim=-2)).sum(dim=-2)
