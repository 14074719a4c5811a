"""Where a shape's parts are in clouds whose points have parts: every part fills the box of its points.

Parts that slide keep their orientation, so boxes along the axes of a common frame say all: how far a part is stretched,
how far it has slid, and where else it lies. Nothing descends.

How far a part has slid is how far its middle is from the middle of the body, less than in the shape. Where the shape,
once it is stretched, has its parts at rest says it less well: that depends on points about which they stretch, which
nothing in a cloud says (docs/experiments.md, steps 181 and 183).

Depth views of drawers show their fronts, and nothing of how far these reach back. There fronts take the place of
middles, and what slides is as much longer or shorter than in the shape as the body is. Of the body a view may show one
side; where no part sticks out of it but by sliding, it reaches as far across as the whole object does (step 190).
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import MIN_POINTS, ArticulatedShape
from articulate_ssl.shape.stretch import hinged, stretch_matrices

_OUTSIDE = 0.03  # share of a part's points that may lie outside of its box, at either end: labels are not exact
_NOISE = 0.01  # likewise of a whole object's
_STICKS_OUT = 0.02  # of the shape's width. Chosen.


def fit_part_boxes(
    shape: ArticulatedShape,  # whose parts slide along an axis of the frame
    clouds: Tensor,  # [n, N, 3] in a frame common to them and the shape
    part: Tensor,  # [n, N] of their points
    front: Tensor | None = None,  # [J] 1 or -1
) -> InstanceFit:
    """The shape in every cloud, stretched; a part with too few points stays where the shape has it, as large.

    Args:
        front: Which end of every part that slides, and of the body, views show: that to which its axis points, or the
            other; None if both ends are seen.
    """
    generator = torch.Generator()  # of points that nothing draws
    axes = torch.eye(3).to(clouds).expand(shape.num_parts, 3, 3)
    low, high, seen = part_boxes(clouds, part, shape.num_parts)
    own_low, own_high, _ = part_boxes(shape.points[None], shape.label[None], shape.num_parts)
    root, children, axis = shape.joints.chain.root, list(shape.joints.chain.child), shape.joints.axis
    along = axis.abs() > 0.5  # [J, 3]
    if front is not None:
        reaches = _reaches_as_far(own_low[0], own_high[0], root) & ~along.any(dim=0)
        whole = torch.quantile(clouds, torch.tensor([_NOISE, 1 - _NOISE]).to(clouds), dim=1)
        low[:, root] = torch.where(reaches, whole[0], low[:, root])
        high[:, root] = torch.where(reaches, whole[1], high[:, root])
    center, own_center = (low + high) / 2, (own_low + own_high)[0] / 2
    size, own_size = (high - low).clamp(min=1e-6), (own_high - own_low).clamp(min=1e-6)
    ratio = torch.where(seen[..., None], size / own_size, 1.0)
    if front is not None:
        ratio[:, children] = torch.where(along, ratio[:, root, None], ratio[:, children])
    # Stretches are bounded; the places of parts follow from what is left of them.
    still = torch.eye(4).to(clouds).expand(len(clouds), 4, 4)
    start = clouds.new_zeros(len(clouds), len(children))
    log_stretch = InstanceFit(shape, still, start, generator, axes, ratio.log()).log_stretch
    rest, _ = hinged(stretch_matrices(axes, log_stretch), shape.part(root).mean(dim=0), shape.joints)
    at_rest = torch.einsum("nkij,kj->nki", rest.linear, own_center) + rest.shift  # [n, K, 3]
    shift = torch.where(seen[:, root, None], center[:, root] - at_rest[:, root], 0.0)
    if front is None:
        apart = (center - center[:, root, None]) - (own_center - own_center[root])
        slid = (apart[:, children] * axis).sum(dim=-1)
    else:
        outward = front[:, None] * axis
        (out, body), (own_out, own_body) = (
            (_ends(*boxes, children, outward), _ends(*boxes, [root] * len(children), outward))
            for boxes in ((low, high), (own_low, own_high))
        )
        slid = front * ((out - body) - (own_out - own_body))
        depth = ((log_stretch.exp() * own_size)[:, children] * along).sum(dim=-1)
        center[:, children] = torch.where(along, (out - depth / 2)[..., None] * outward, center[:, children])
    known = seen[:, children] & seen[:, root, None]
    state = shape.joints.clamped(torch.where(known, slid, 0.0))
    beside = torch.zeros_like(center)
    beside[:, children] = (center - at_rest - shift[:, None])[:, children] - state[..., None] * axis
    base = se3(torch.eye(3).to(clouds).expand(len(clouds), 3, 3), shift)
    beside = torch.where(seen[..., None], beside, 0.0)
    return InstanceFit(shape, base, state, generator, axes, log_stretch, beside)


def _reaches_as_far(
    low: Tensor,  # [K, 3]
    high: Tensor,  # [K, 3]
    root: int,
) -> Tensor:  # [3] bool
    """Along which axes no part of a shape sticks out of its body."""
    slack = _STICKS_OUT * (high.amax(dim=0) - low.amin(dim=0))
    return (low[root] <= low.amin(dim=0) + slack) & (high[root] >= high.amax(dim=0) - slack)


def _ends(
    low: Tensor,  # [n, K, 3]
    high: Tensor,  # [n, K, 3]
    parts: list[int],
    outward: Tensor,  # [J, 3]
) -> Tensor:  # [n, J]
    """How far out J parts reach."""
    return (torch.where(outward > 0, high[:, parts], low[:, parts]) * outward).sum(dim=-1)


def part_boxes(
    clouds: Tensor,  # [n, N, 3]
    part: Tensor,  # [n, N]
    num_parts: int,
) -> tuple[Tensor, Tensor, Tensor]:  # [n, K, 3], [n, K, 3], [n, K] whether there are points enough
    """Lowest and highest corner of every part."""
    low, high = (clouds.new_zeros(len(clouds), num_parts, 3) for _ in range(2))
    seen = torch.zeros(len(clouds), num_parts, dtype=torch.bool, device=clouds.device)
    limits = torch.tensor([_OUTSIDE, 1 - _OUTSIDE]).to(clouds)
    for i, (cloud, label) in enumerate(zip(clouds, part, strict=True)):
        for k in range(num_parts):
            mine = cloud[label == k]
            if len(mine) >= MIN_POINTS:
                low[i, k], high[i, k] = torch.quantile(mine, limits, dim=0)
                seen[i, k] = True
    return low, high, seen
