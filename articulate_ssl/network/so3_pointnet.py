"""SO(3)-PointNet: group-indexed features of whole parts, and attention pooling over the group (paper, Sec. 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.ops.normalization import layer_norm_leaky_relu

_SLOPE = 0.1


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
            nn.LeakyReLU(_SLOPE),
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
        first, norm, _, last, _ = self.perceptron
        of_features, of_points = first.weight.split([features.shape[-1], 3], dim=1)
        # A_g^T x is linear in x: all group elements at once, and neither concatenation nor its gradient.
        seen = torch.einsum("gij,dj->igd", self.elements.to(of_points), of_points)
        hidden = (points.to(of_points) @ seen.flatten(1)).view(-1, len(first.bias)) + first.bias
        hidden = hidden + features.flatten(0, 2) @ of_features.T
        hidden = layer_norm_leaky_relu(hidden, norm.weight, norm.bias, _SLOPE, norm.eps)
        hidden = last(hidden).view(*features.shape[:-1], -1)
        # max_i w_i relu(h_i) = relu(max_i w_i h_i)
        return largest_product(hidden.flatten(2), association).relu().unflatten(2, (features.shape[2], -1))


def largest_product(
    features: Tensor,  # [B, M, D]
    weight: Tensor,  # [B, M, K]
) -> Tensor:  # [B, K, D]
    """max over m of weight[m, k] features[m, d]: winners without gradient, then their products with gradient."""
    with torch.no_grad():
        index = torch.stack([(features * w[..., None]).max(dim=1).indices for w in weight.unbind(-1)], dim=1)
    return features.gather(1, index) * weight.transpose(1, 2).gather(2, index)


class GroupAttentionPooling(nn.Module):
    """Invariant features: a softmax over the group, one logit per group element (paper: attention pooling)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.logit = nn.Linear(dim, 1)

    def forward(self, features: Tensor) -> Tensor:
        """[..., G, C] -> [..., C]; unchanged when the group index is permuted."""
        return (features * self.logit(features).softmax(dim=-2)).sum(dim=-2)
