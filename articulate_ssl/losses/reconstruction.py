"""Part-by-part shape reconstruction (paper, Sec. 3.3): the distance between a cloud and its posed canonical parts.

All distances are of L1 type (unsquared): with squared ones a laptop whose base and lid are exchanged is a stable
optimum, because a few far points outweigh many near ones.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.ops.chamfer import nearest_index

_TINY = 1e-8
_SINKHORN_ROUNDS = 5  # chosen without a measurement


def distances_to_parts(
    points: Tensor,  # [B, N, 3]
    posed: Tensor,  # [B, K, M, 3]
    neighbours: int = 1,
) -> Tensor:  # [B, N, K]
    """Distance of every input point to every posed part; differentiable in the parts.

    Args:
        neighbours: Mean distance to so many points of the part, or to all, if it has fewer.
    """
    if neighbours > 1:
        count = min(neighbours, posed.shape[2])
        near = torch.cdist(points[:, None], posed).topk(count, largest=False).values  # [B, K, N, count]
        return near.mean(dim=-1).transpose(1, 2)
    query = points[:, None].expand(-1, posed.shape[1], -1, -1)
    return _gap(query, posed, nearest_index(query, posed)).transpose(1, 2)


def distances_to_cloud(
    posed: Tensor,  # [B, K, M, 3]
    points: Tensor,  # [B, N, 3]
    labels: Tensor | None = None,  # [B, N]
) -> Tensor:  # [B, K, M]
    """Distance of every posed point to the nearest input point; with labels, to the nearest point of its own part.

    A part that owns no input point is compared with all of them.
    """
    target = points[:, None].expand(-1, posed.shape[1], -1, -1)
    foreign = None
    if labels is not None:
        foreign = labels[:, None] != torch.arange(posed.shape[1], device=points.device)[:, None]  # [B, K, N]
        foreign = foreign & ~foreign.all(dim=-1, keepdim=True)
    return _gap(posed, target, nearest_index(posed, target, foreign))


def posterior_association(
    to_part: Tensor,  # [B, N, K]
    scale: float,
) -> Tensor:  # [B, N, K]
    """Posterior of the parts given the posed shapes, softmax(-d^2 / 2 s^2), without gradient."""
    return (to_part.detach().square() / (-2 * scale**2)).softmax(dim=-1)


def balanced_association(
    to_part: Tensor,  # [B, N, K]
    scale: float,
    balance: float,
) -> Tensor:  # [B, N, K]
    """The posterior association with parts drawn to equal shares of each cloud, by Sinkhorn's rounds; no gradient.

    Args:
        scale: See `posterior_association`.
        balance: How far they are drawn, from 0 (the posterior) to 1 (equal shares, up to what the rounds leave).
    """
    logits = to_part.detach().square() / (-2 * scale**2)
    for _ in range(_SINKHORN_ROUNDS):
        logits = logits - balance * logits.logsumexp(dim=1, keepdim=True)
        logits = logits - logits.logsumexp(dim=2, keepdim=True)
    return logits.exp()


def owned_parts(
    labels: Tensor,  # [B, N]
    num_parts: int,
) -> Tensor:  # [B, K] bool
    """Whether any point belongs to a part."""
    return (labels[:, :, None] == torch.arange(num_parts, device=labels.device)).any(dim=1)


def part_by_part(
    to_part: Tensor,  # [B, N, K]
    to_cloud: Tensor | None,  # [B, K, M], None for the unidirectional distance
    association: Tensor,  # [B, N, K], rows sum to one
    owned: Tensor | None = None,  # [B, K] bool, of which parts the way back counts; None counts all
) -> Tensor:  # [B]
    """Association-weighted distance of the input to the parts, plus that of the parts to the input."""
    loss = (association * to_part).sum(dim=-1).mean(dim=-1)
    if to_cloud is None:
        return loss
    return loss + (to_cloud.mean(dim=(-1, -2)) if owned is None else _mean_of(to_cloud.mean(dim=-1), owned))


def part_of_mass(
    to_part: Tensor,  # [B, N, K]
    to_cloud: Tensor | None,  # [B, K, M], None for the unidirectional distance
    association: Tensor,  # [B, N, K], rows sum to one
    owned: Tensor,  # [B, K] bool
) -> Tensor:  # [B]
    """The mean over the owned parts of each one's distance: of its own points to it, plus of it to its own points."""
    mass = association.sum(dim=1).clamp_min(_TINY)
    distance = (association * to_part).sum(dim=1) / mass
    return _mean_of(distance if to_cloud is None else distance + to_cloud.mean(dim=-1), owned)


def whole_shape(
    to_part: Tensor,  # [B, N, K]
    to_cloud: Tensor | None,  # [B, K, M], without labels
) -> Tensor:  # [B]
    """d(X, Y): Chamfer distance between the input and the union of the posed parts."""
    loss = to_part.amin(dim=-1).mean(dim=-1)
    return loss if to_cloud is None else loss + to_cloud.mean(dim=(-1, -2))


def _mean_of(value: Tensor, counted: Tensor) -> Tensor:
    """Mean over those of the last dimension that count, [B, K] -> [B]."""
    return (value * counted).sum(dim=-1) / counted.sum(dim=-1).clamp_min(1)


def _gap(query: Tensor, target: Tensor, index: Tensor) -> Tensor:
    """Length of query - target[index], with a finite gradient at zero."""
    near = target.gather(-2, index[..., None].expand_as(query))
    return ((query - near).square().sum(dim=-1) + _TINY).sqrt()
