"""Registration's last step: every part in the cloud's own proportions.

Objects of a category differ in proportions, and the network's stretches say so only roughly. Where a part is longer or
shorter than its shape, registration turns it to make up for that. So in the end pose, joint states, the stretch of
every part and where its hinge is descend together, each cloud's on its own (`discovery.instance_fit`), to a smaller
distance between cloud and shape. Where faces say along which axes parts stretch, they start as wide as the whole cloud
is: what is far off hardly pulls, and bodies half as wide again as their category's stayed as they were, so that other
explanations won (docs/experiments.md, step 349). Parts stay hinged, axes stay as the network says. Where distances
count one way, what a view hides pulls at nothing. Where parts were found in views alone, which leave open where their
hinge is, parts are drawn to it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape

_WIDEST = 0.5  # largest log-stretch of what starts as wide as its cloud: 1.65. Chosen.
_ENDS = 0.005  # share of points beyond what is taken for the ends of a cloud, or a shape: strays are some. Chosen.


class Descent(NamedTuple):
    """How a shape descends to clouds.

    Attributes:
        cycles: Of descent.
        bidirectional: Distances count both ways.
        touching: Both parts of a joint are drawn to its line (`InstanceFit.optimise`).
        faces: [K, 3, 3] columns, axes along which parts stretch instead of their principal ones, which of a body about
            as wide as high are any; then it would shear.
        known: [B] and [B, J] bool: which clouds stay turned as they are, and which joint states stay.
        frame: [3, 3] columns, axes of the object, whose parts slide: all stretch along these, and may lie elsewhere.
    """

    cycles: int
    bidirectional: bool = True
    touching: bool = False
    faces: Tensor | None = None
    known: tuple[Tensor, Tensor] | None = None
    frame: Tensor | None = None


def fit_proportions(
    one: Hypotheses,  # H = 1
    category: ArticulatedShape,
    points: Tensor,  # [B, N, 3]
    descent: Descent,
) -> Hypotheses:  # H = 1
    """The category's shape in the proportions of clouds, from where explanations of them are.

    Its points are the category's, as the network's own stretches and displacements of them say no more about which
    part is where (docs/experiments.md, step 118); joint lines are those of the explanations.

    Args:
        category: Every part has as many points.
    """
    fit, base = descended(one, category, points, descent)
    return with_instances(one, fit.instances()).at((base @ fit.base)[:, None], fit.state[:, None])


def with_instances(
    one: Hypotheses,  # H = 1
    instances: ArticulatedShape,  # of B clouds, in canonical object space
) -> Hypotheses:  # H = 1
    """Explanations with clouds' own shapes and pivots, where they were."""
    parts = torch.stack([instances.part(part) for part in range(instances.num_parts)], dim=1)
    center = parts.mean(dim=2)
    own = CanonicalShape(parts - center[:, :, None], center)
    return replace(one, shape=own, structure=replace(one.structure, pivot=instances.joints.pivot))


def descended(
    one: Hypotheses,  # H = 1
    category: ArticulatedShape,
    points: Tensor,  # [B, N, 3]
    descent: Descent,
) -> tuple[InstanceFit, Tensor]:  # , [B, 4, 4]
    """See `fit_proportions`: the fit to clouds in the frames of explanations, and their poses before it."""
    cycles, both, touching, faces, known, frame = descent
    # A test runs in inference mode, whose tensors no gradient goes through.
    with torch.inference_mode(False):
        lines = replace(category.joints, axis=one.axis[:, 0].clone(), pivot=one.pivot.clone())
        shape = ArticulatedShape(category.points.clone(), category.label.clone(), lines)
        # Seen in the object's frame, a cloud that is turned is descended on alike.
        base = one.base[:, 0].clone()
        seen, still = transform_points(invert_se3(base), points.clone()), torch.eye(4).to(base).expand_as(base)
        faces = None if faces is None else faces.clone()
        axes = None if frame is None else frame.expand(shape.num_parts, 3, 3).clone()
        state, generator = one.state[:, 0].clone(), torch.Generator().manual_seed(0)
        if faces is not None and both:
            start = _as_wide_as(seen, shape, state, faces)
            fit = InstanceFit(shape, still, state, generator, axes, start, faces=faces, bound=_WIDEST)
        else:
            fit = InstanceFit(shape, still, state, generator, axes, faces=faces)
        known = None if known is None else tuple(value.clone() for value in known)
        fit.optimise(seen, cycles, shared=False, bidirectional=both, touching=touching, known=known)
        return fit, base


@torch.no_grad()
def _as_wide_as(
    clouds: Tensor,  # [B, N, 3] in the frame of the shape
    shape: ArticulatedShape,
    state: Tensor,  # [B, J]
    faces: Tensor,  # [K, 3, 3] columns
) -> Tensor:  # [B, K, 3]
    """Log-stretches of parts along their faces, with which the whole is about as wide as clouds are.

    Along the axes of the root, all parts by as much; others as they are turned.
    """
    root, still = shape.joints.chain.root, torch.eye(4).to(clouds).expand(len(clouds), 4, 4)
    axes = faces[root]
    ratio = _extents(clouds @ axes) / _extents(shape.posed(still, state) @ axes).clamp(min=1e-6)
    turned = shape.joints.part_pose(still, state)[..., :3, :3] @ faces  # [B, K, 3, 3]
    return (ratio[:, None, :, None] * (axes.mT @ turned)).norm(dim=2).log()


def _extents(points: Tensor) -> Tensor:  # [B, N, 3] -> [B, 3]
    return points.quantile(1 - _ENDS, dim=1) - points.quantile(_ENDS, dim=1)
