"""SO(3)-PointNet: group-indexed features of whole parts, and attention pooling over the group (paper, Sec. 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.geometry.directions import Directions, icosahedron_directions
from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.ops.extreme_index import index_of_largest
from articulate_ssl.ops.normalization import layer_norm_leaky_relu

_SLOPE = 0.1


def _perceptron(in_dim: int, out_dim: int) -> nn.Sequential:
    layers = nn.Linear(in_dim, out_dim), nn.LayerNorm(out_dim), nn.LeakyReLU(_SLOPE)
    return nn.Sequential(*layers, nn.Linear(out_dim, out_dim), nn.ReLU())


class SO3PointNet(nn.Module):
    """Part features from point features: a perceptron on (feature, A_g^T x), then a maximum over a part's points.

    Output channel (k, g) is the response of part k to the cloud as seen from group element g, so rotating the cloud by
    a group element permutes g, like the backbone's features.
    """

    def __init__(self, in_dim: int, out_dim: int, elements: Tensor) -> None:
        """Args: input and output channels; `elements` [G, 3, 3], the group's rotation matrices."""
        super().__init__()
        self.register_buffer("elements", elements, persistent=False)
        self.perceptron = _perceptron(in_dim + 3, out_dim)

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
        # In mixed precision, products of features are rounded, and coordinates are not.
        with torch.autocast(points.device.type, enabled=False):
            seen = torch.einsum("gij,dj->igd", self.elements.to(of_points), of_points)
            hidden = (points.to(of_points) @ seen.flatten(1)).view(-1, len(first.bias)) + first.bias
        hidden = hidden + features.flatten(0, 2) @ of_features.T
        hidden = layer_norm_leaky_relu(hidden, norm.weight, norm.bias, _SLOPE, norm.eps)
        hidden = last(hidden).view(*features.shape[:-1], -1)
        return largest_product(hidden.flatten(2), association).unflatten(2, (features.shape[2], -1))


class DirectionPointNet(nn.Module):
    """An `SO3PointNet` of features on directions: parts are pooled per direction, then read as functions of rotations.

    Group element g orders the directions as g v_1, ..., g v_12. The pooled features in this order determine the feature
    at g, as in E2PN's permutation layer. Of a point, direction v sees how far along v it is, and how far away: what is
    left of its coordinates by the rotations that leave v where it is.
    """

    def __init__(self, in_dim: int, out_dim: int, directions: Directions) -> None:
        """Args: input and output channels; the directions of the input."""
        super().__init__()
        self.register_buffer("vectors", directions.vectors, persistent=False)
        self.register_buffer("order", directions.action.T.contiguous(), persistent=False)
        self.perceptron = _perceptron(in_dim + 2, out_dim)
        fan_in = len(directions.vectors) * out_dim
        self.to_group = nn.Parameter(torch.randn(len(directions.vectors), out_dim, out_dim) * (2 / fan_in) ** 0.5)
        self.norm = nn.LayerNorm(out_dim)

    def forward(
        self,
        features: Tensor,  # [B, M, V, C]
        points: Tensor,  # [B, M, 3], in the frame the features were computed in
        association: Tensor,  # [B, M, K], how much each point belongs to each part
    ) -> Tensor:  # [B, K, G, C']
        """Pool points into parts as `SO3PointNet` does, and order the directions."""
        with torch.autocast(points.device.type, enabled=False):
            along = points @ self.vectors.to(points).T  # [B, M, V]
        away = points.norm(dim=-1, keepdim=True).expand_as(along)
        first, norm, _, last, _ = self.perceptron
        hidden = first(torch.cat([features, torch.stack([along, away], dim=-1)], dim=-1))
        hidden = layer_norm_leaky_relu(hidden, norm.weight, norm.bias, _SLOPE, norm.eps)
        pooled = largest_product(last(hidden).flatten(2), association).unflatten(2, (features.shape[2], -1))
        ordered = sum((pooled @ w).index_select(2, i) for w, i in zip(self.to_group, self.order, strict=True))
        return layer_norm_leaky_relu(ordered, self.norm.weight, self.norm.bias, _SLOPE, self.norm.eps)


def largest_product(
    features: Tensor,  # [B, M, D]
    weight: Tensor,  # [B, M, K], not negative
) -> Tensor:  # [B, K, D]
    """max over m of weight[m, k] relu(features[m, d]): winners without gradient, then their products with gradient."""
    with torch.no_grad():
        index = torch.stack([index_of_largest(features * w[..., None], 1) for w in weight.unbind(-1)], dim=1)
    return features.gather(1, index).relu() * weight.transpose(1, 2).gather(2, index)


def part_pointnet(in_dim: int, out_dim: int, group: RotationGroup, directions: bool) -> SO3PointNet | DirectionPointNet:
    """The PointNet that reads a backbone's features, on directions or on the group."""
    if directions:
        return DirectionPointNet(in_dim, out_dim, icosahedron_directions(group))
    return SO3PointNet(in_dim, out_dim, group.elements)


class GroupAttentionPooling(nn.Module):
    """Invariant features: a softmax over the group, one logit per group element (paper: attention pooling)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.logit = nn.Linear(dim, 1)

    def forward(self, features: Tensor) -> Tensor:
        """[..., G, C] -> [..., C]; unchanged when the group index is permuted."""
        return (self.logit(features).softmax(dim=-2).transpose(-1, -2) @ features).squeeze(-2)
