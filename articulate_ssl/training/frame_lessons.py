"""What `inference.part_frames` and `inference.common_shape` are learnt from: predictions of training clouds.

How the faces of their parts lie, or if they have none, which joints are parallel to the body (`line_lessons`); then,
unless scans have taught it, where joint lines are; and, of complete clouds that are turned as faces say, what they have
in common. Or, where parts slide, how views are turned (`inference.object_frame`), which part their points are of
(`view_lessons`), and which ends of parts they show (`inference.front_ends`).
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from trimesh.bounds import oriented_bounds

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.part_frames import WINDOWS, Faces, faces_of
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.inference.proportions import Descent, descended
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.fusion import fused
from articulate_ssl.shape.object_axes import object_axes
from articulate_ssl.shape.part_maps import PartMaps
from articulate_ssl.training.explanations import registered_points
from articulate_ssl.training.line_lessons import explain, learn_joint_axes, learn_joint_lines
from articulate_ssl.training.view_lessons import teach_view_parts

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_THICKNESS = 1e-4  # in normalised units
# Clouds that are explained with and without faces, and how much larger distances may be with them: of five sets of
# weights that faces make better they are .97 to 1.06 times as large, of eyeglasses, whose frames only look flat, 1.31
# (docs/experiments.md, step 192). Chosen.
_TRIED, _WORSE = 64, 1.15
_CLOUDS, _BEST = 128, 0.7  # that are laid over each other, and of them the share that fits best: some are turned over

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_part_frames(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out which parts have faces that say how they are turned, then where joint lines are and what is common.

    The last of complete clouds alone. Where parts slide, it is how whole objects are turned.
    """
    estimator = module.estimator
    if module.articulated.joint_type != REVOLUTE:
        _learn_object_frame(module, clouds)
        return
    frames = estimator.part_frames
    frames.flat.fill_(False)
    estimator.common_shape.forget()
    explained = explain(module, clouds, "faces of parts")
    rows = torch.arange(len(clouds), device=clouds.device).split(_BATCH)
    faces = [
        [faces_of(explained.rows(some), clouds[some], [window] * module.num_parts) for window in WINDOWS]
        for some in rows
    ]
    every = tuple(Faces(*map(torch.cat, zip(*seen, strict=True))) for seen in zip(*faces, strict=True))
    network = module.articulated
    start = rough_axes(network.category.articulated_shape(network.joint_type))
    quality = frames.learn(explained, every, start)
    for part, (share, angle) in enumerate(quality.tolist()):
        flat = "has" if frames.flat[part] else "has no"
        tell(log, "part %d %s faces: %.0f %% of clouds alike, %.1f degrees", part, flat, 100 * share, angle)
    if frames.learnt and not _explain_as_well(module, explained, clouds):
        frames.flat.fill_(False)
        frames.measured.fill_(False)
        tell(log, "turned as faces say, shapes fit worse: they say nothing")
    turned = not frames.measured.any() and learn_joint_axes(module, explained, clouds)
    observation = estimator.observation
    views = observation.orientation.limited
    if views and not observation.bidirectional:
        return  # complete scans, which taught these views, show where lines are
    if turned:
        explained = explain(module, clouds, "joint axes")
    few = slice(_CLOUDS)
    explained = explained.rows(torch.arange(len(clouds), device=clouds.device)[few])
    explained = learn_joint_lines(module, explained, clouds[few])
    if frames.learnt and not views:
        _learn_common_shape(module, explained, clouds[few])


def _explain_as_well(module: ArticulatedPoseModule, explained: Hypotheses, clouds: Tensor) -> bool:
    """Whether the category's shape fits clouds that are turned as faces say about as well as where it may turn."""
    final, frames, few = module.estimator.final, module.part_frames, clouds[:_TRIED]
    points, one = few[:, : registered_points(module)], explained.rows(torch.arange(len(few), device=few.device))
    faces = final.distance(final.in_proportion(one, points, few), points)
    flat = frames.flat.clone()
    frames.flat.fill_(False)
    free = final.distance(final.in_proportion(one, points, few), points)
    frames.flat.copy_(flat)
    return bool((faces / free).median() < _WORSE)


def _learn_object_frame(module: ArticulatedPoseModule, clouds: Tensor) -> None:
    """How views of what slides are turned; and as that is known, which part their points are of, and where they end."""
    network, frame, search = module.articulated, module.object_frame, module.view_search
    ends = module.front_ends
    if frame.surface is not None:
        tell(log, "which turns look right has to be learnt anew: it was taught for other axes (lesson view_turns)")
    frame.forget()
    ends.forget()
    search.parts = None
    explained = explain(module, clouds, "frames of views")
    start = object_axes(network.category.articulated_shape(network.joint_type))
    share = frame.learn(explained.base[:, 0, :3, :3], clouds, start * torch.linalg.det(start).sign())
    says = "says" if frame.learnt else "does not say"
    tell(log, "%.0f %% of views are nearly as their Manhattan frame: it %s how they are turned", 100 * share, says)
    if frame.learnt:
        search.parts = teach_view_parts(search.standing @ frame.axes, search.part, module.num_parts)
        _learn_front_ends(module, clouds)


def _learn_front_ends(module: ArticulatedPoseModule, clouds: Tensor) -> None:
    """Which ends of what slides views show."""
    network = module.articulated
    shown = announced(log, "ends of parts that views show", clouds.split(_BATCH))
    count, read = registered_points(module), module.num_points
    found = concatenate([module.estimator.predict(some[:, :count], read, dense=some) for some in shown])
    category = network.category.articulated_shape(network.joint_type)
    turn, part = found.base_pose[:, :3, :3], found.dense_part_id
    with_fits = module.front_ends.learn(module.object_frame, category, turn, clouds, part, found.joint_state)
    does = "are fronts" if module.front_ends.learnt else "say nothing: what is read at either does not go with fits"
    shares = ", ".join(f"{value:.2f}" for value in with_fits.tolist())
    tell(log, "ends of parts %s (correlation with what was fitted: %s)", does, shares)


def _learn_common_shape(module: ArticulatedPoseModule, explained: Hypotheses, clouds: Tensor) -> None:
    """Lay the clouds that fit best over each other, part by part."""
    estimator, network = module.estimator, module.articulated
    frames, category = estimator.part_frames, network.category.articulated_shape(network.joint_type)
    one, known = frames.settled(explained, clouds)
    points, cycles = clouds[:, : registered_points(module)], estimator.inference.proportions
    fit, base = descended(one, category, points, Descent(cycles, faces=frames.axes, known=known))
    seen = transform_points(invert_se3(base), clouds)
    best = fit.error(seen).argsort()[: int(_BEST * len(clouds))]
    maps = fit.maps()
    pivot = fit.shape.joints.pivot[best].median(dim=0).values
    axis = torch.where(frames.measured[:, None], frames.direction, category.joints.axis)
    shape = replace(category, joints=replace(category.joints, axis=axis, pivot=pivot))
    shape = fused(shape, PartMaps(maps.linear[best], maps.shift[best]), seen[best])
    if shape is not None:
        estimator.common_shape.set(shape)


def rough_axes(shape: ArticulatedShape) -> Tensor:  # [K, 3, 3] columns
    """Of the smallest box about the root, and of those about other parts that have their hinge for an edge."""
    # About a sheet without thickness, or what has collapsed to less, there is no smallest box.
    noise = torch.randn(shape.points.shape, generator=torch.Generator().manual_seed(0))
    shape = replace(shape, points=shape.points + _THICKNESS * noise.to(shape.points))
    chain, axes = shape.joints.chain, [None] * shape.num_parts
    box = oriented_bounds(shape.part(chain.root).double().cpu().numpy(), angle_digits=2)[0]
    axes[chain.root] = torch.from_numpy(box[:3, :3].T.copy()).to(shape.points)
    for joint, part in enumerate(chain.child):
        line = replace(shape.joints, axis=shape.joints.axis[joint, None], chain=replace(chain, root=part))
        axes[part] = object_axes(replace(shape, joints=line))
    return torch.stack([some * torch.linalg.det(some).sign() for some in axes])
