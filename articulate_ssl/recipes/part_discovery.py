"""Part discovery: find a category's parts and joints from unlabelled clouds alone, by registration.

1. *Rigid alignment*: one typical cloud is registered to all others from every group rotation.
2. *Splits*: cut the typical cloud into K pieces at random, register every piece to every aligned cloud on its own, and
   give each template point to the piece whose motion explains it best in all clouds: points that move together end up
   together. Of many random cuts the winner is the one that reconstructs best *after* each pair's relative motion has
   been reduced to one joint, which is what a wrong split cannot survive.
3. *Rounds*: search every cloud again with the articulated template, from many orientations (this is what rights clouds
   that the rigid template fitted upside down), then solve labels and joints again from the clouds that fit.

No network, no gradient, no label. It is to the staged recipe what the "zero iteration" is to the original.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.groups import rotation_group
from articulate_ssl.kinematic_chain import extract_chain, pair_index
from articulate_ssl.recipes.screw_fit import fit_screw
from articulate_ssl.registration import (
    JointModel,
    LabelledTemplate,
    chamfer_l1,
    register_articulated,
    register_rigid,
    search_articulated,
    update_poses,
)
from datamodules.geometry import invert_se3, se3, transform_points

log = logging.getLogger(__name__)


class DiscoveryError(RuntimeError):
    """The clouds do not show the parts that were asked for."""


@dataclass(frozen=True)
class DiscoveryOptions:
    """How much work part discovery does.

    Attributes:
        clouds: Training clouds that are registered.
        split_clouds: The best aligned of them, on which splits are tried.
        search_clouds: Those on which labels and joints are solved again; all are registered in the end.
        points: Points per cloud and template in registration.
        dense_points: The same where it is decided between registrations.
        starts: Random splits.
        jointed: The splits that explain the clouds best, to which joints are fitted.
        rounds: Rounds of articulated search, relabelling and joint fitting.
        keep: Share of the clouds, best fitted first, that labels and joints are solved from.
        min_share: Splits with a part smaller than this share of the template are discarded.
        seed: Of the random splits.
    """

    clouds: int = 192
    split_clouds: int = 48
    search_clouds: int = 96
    points: int = 256
    dense_points: int = 1024
    starts: int = 24
    jointed: int = 6
    rounds: int = 3
    keep: float = 0.75
    min_share: float = 0.05
    seed: int = 0


@dataclass(frozen=True)
class ArticulatedTemplate:
    """A category's labelled template with joints, registered to n clouds.

    Canonical object space has the template's principal axes as coordinate axes, so that the half-turns under which an
    object nearly maps to itself are elements of the rotation group. Every joint is at the clouds' mean state.

    Attributes:
        template: [T] labelled points.
        joints: Joint lines and kinematic chain.
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J] zero-mean joint states.
        error: [n] Chamfer-L1 distance of every cloud to its reconstruction.
    """

    template: LabelledTemplate
    joints: JointModel
    base: Tensor
    state: Tensor
    error: Tensor

    def part_pose(self) -> Tensor:
        """[n, K, 4, 4] canonical object space -> cloud."""
        return self.joints.part_pose(self.base, self.state)


def discover(
    clouds: Tensor,  # [n, N, 3] in any orientation
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
) -> ArticulatedTemplate:
    """Parts and joints of the category, registered to all the clouds.

    Raises:
        DiscoveryError: if no split into `num_parts` moving parts survives.
    """
    clouds = clouds[:, : options.dense_points].contiguous()
    reference = clouds[choose_reference(clouds)]
    rotations = rotation_group(60).elements.to(clouds)
    coarse = max(64, options.points // 2)
    few = clouds[:: max(1, len(clouds) // options.search_clouds)][: options.search_clouds]
    thin = few[:, : options.points]
    rigid, error = register_rigid(reference[:coarse], thin[:, :coarse], rotations, keep=1)
    log.info("rigid alignment: median Chamfer-L1 %.4f", error[:, 0].median())

    best_aligned = error[:, 0].argsort()[: options.split_clouds]
    aligned = transform_points(invert_se3(rigid[best_aligned, 0]), thin[best_aligned])
    found = split_template(aligned, reference, num_parts, joint_type, options)
    log.info("best split of %d starts: Chamfer-L1 %.4f", options.starts, found.error.mean())

    for step in range(options.rounds):
        base, state, error = _search(found, few, rotations)
        kept = error.argsort()[: max(1, int(options.keep * len(few)))]
        pose = found.joints.part_pose(base[kept], state[kept])
        template = found.template
        for scale in (0.03, 0.028, 0.026, 0.024, 0.022, 0.02):
            pose = update_poses(template.thinned(options.points), pose, thin[kept], scale)
            template = relabel(template, pose, thin[kept], cap=4 * scale)
        if torch.bincount(template.label, minlength=num_parts).min() < options.min_share * len(template.label):
            log.warning("round %d lost a part; keeping the parts of the round before", step + 1)
            break
        found = fit_joints(template, pose, thin[kept], joint_type)
        log.info("round %d: Chamfer-L1 %.4f of the kept clouds", step + 1, found.error.mean())
    base, state, error = _search(found, clouds, rotations)
    return replace(found, base=base, state=state, error=error)


def _search(found: ArticulatedTemplate, clouds: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    spread = 1.5 * found.state.std(dim=0)
    # The middle, and every combination of either side.
    states = torch.cartesian_prod(*torch.stack([-spread, spread], dim=-1)).view(-1, len(spread))
    states = torch.cat([torch.zeros_like(states[:1]), states])
    limits = torch.quantile(found.state, torch.tensor([0.05, 0.95]).to(states), dim=0)
    margin = 0.15 * (limits[1] - limits[0])
    joints = replace(found.joints, limits=torch.stack([limits[0] - margin, limits[1] + margin], dim=-1))
    return search_articulated(found.template, joints, clouds, rotations, states)


def dense_template(
    found: ArticulatedTemplate,
    clouds: Tensor,  # [n, P, 3] the clouds that `found` is registered to, more densely
    points: int = 1024,
    keep: float = 0.75,
) -> LabelledTemplate:
    """A denser template: the best fitted cloud near the canonical state, every point labelled by all clouds' evidence.

    Parts that lie against each other (a closed laptop) cannot be told apart in one cloud, hence a cloud near the mean
    state, and hence the labels from which part's motion explains a point in the other clouds.

    Raises:
        DiscoveryError: if a part is left without points.
    """
    clouds = clouds[:, :points]
    distance = (found.state / found.state.std(dim=0)).abs().amax(dim=1)
    central = distance <= distance.quantile(0.3)
    reference = int(found.error.masked_fill(~central, torch.inf).argmin())
    pose = found.part_pose()
    inverse = invert_se3(pose[reference])
    cloud = clouds[reference]
    nearest = torch.cdist(cloud, found.template.posed(pose[reference, None])[0]).argmin(dim=1)
    label = found.template.label[nearest]
    kept = found.error.argsort()[: max(1, int(keep * len(clouds)))]
    rows = torch.arange(len(cloud), device=cloud.device)
    for _ in range(2):
        canonical = transform_points(inverse, cloud)[label, rows]
        template = LabelledTemplate(canonical, label, found.template.num_parts)
        label = relabel(template, pose[kept], clouds[kept], cap=0.04).label
    counts = torch.bincount(label, minlength=found.template.num_parts)
    if counts.min() < 4:
        raise DiscoveryError(
            f"part discovery lost a part (points per part: {counts.tolist()}): the clouds do not show "
            f"{found.template.num_parts} parts that move on their own; check the category's number of parts"
        )
    return LabelledTemplate(transform_points(inverse, cloud)[label, rows], label, found.template.num_parts)


def choose_reference(clouds: Tensor) -> int:
    """Index of the most typical cloud: the medoid of the sorted distances to the centre (invariant to rotation)."""
    radius = (clouds - clouds.mean(dim=1, keepdim=True)).norm(dim=-1).sort(dim=1).values
    return int(torch.cdist(radius, radius, p=1).sum(dim=1).argmin())


def random_split(template: Tensor, num_parts: int, generator: torch.Generator) -> Tensor:
    """[T] labels from K - 1 parallel cuts along a random direction, at random quantiles."""
    direction = functional.normalize(torch.randn(3, generator=generator), dim=0)
    height = template @ direction.to(template)
    cuts = (torch.rand(num_parts - 1, generator=generator) * 0.8 + 0.1).sort().values
    return torch.bucketize(height, torch.quantile(height, cuts.to(template)))


def split_template(
    aligned: Tensor,  # [n, N, 3]
    template: Tensor,  # [T, 3]
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
) -> ArticulatedTemplate:
    """Best of many random splits after multi-body registration.

    Raises:
        DiscoveryError: if every start loses a part.
    """
    generator = torch.Generator().manual_seed(options.seed)
    splits = []
    for _ in range(options.starts):
        labelled = LabelledTemplate(template, random_split(template, num_parts, generator), num_parts)
        pose = torch.eye(4).to(template).expand(len(aligned), num_parts, 4, 4)
        for step, scale in enumerate(torch.logspace(-1.1, -1.7, 16).tolist()):
            pose = update_poses(labelled.thinned(options.points), pose, aligned, scale)
            if step % 2 == 1:
                labelled = relabel(labelled, pose, aligned, cap=4 * scale)
        share = torch.bincount(labelled.label, minlength=num_parts) / len(template)
        if share.min() >= options.min_share:
            splits.append((_trimmed(chamfer_l1(aligned, labelled.posed(pose)), options), labelled, pose))
    if not splits:
        raise DiscoveryError(
            f"part discovery lost a part in all {options.starts} starts: the clouds do not show {num_parts} parts that "
            "move on their own; check the category's number of parts, or allow more starts"
        )
    splits.sort(key=lambda split: split[0])
    fits = [fit_joints(labelled, pose, aligned, joint_type) for _, labelled, pose in splits[: options.jointed]]
    return min(fits, key=lambda found: _trimmed(found.error, options))


def _trimmed(error: Tensor, options: DiscoveryOptions) -> float:
    """Mean error of the clouds that fit best: some are aligned wrongly."""
    return float(error.sort().values[: max(1, int(options.keep * len(error)))].mean())


def relabel(
    template: LabelledTemplate,
    pose: Tensor,  # [n, K, 4, 4]
    clouds: Tensor,  # [n, N, 3]
    cap: float,  # distances beyond this count as this
    neighbors: int = 16,
) -> LabelledTemplate:
    """Give every template point to the part whose motion brings it closest to the clouds, smoothed over neighbours."""
    cost = template.points.new_zeros(len(template.points), template.num_parts)
    for part in range(template.num_parts):
        moved = transform_points(pose[:, part], template.points)  # [n, T, 3]
        for cloud, points in zip(clouds.split(32), moved.split(32), strict=True):
            cost[:, part] += torch.cdist(points, cloud).amin(dim=2).clamp(max=cap).sum(dim=0)
    near = torch.cdist(template.points, template.points).topk(neighbors, largest=False).indices
    return replace(template, label=cost[near].mean(dim=1).argmin(dim=-1))


def fit_joints(
    template: LabelledTemplate,
    pose: Tensor,  # [n, K, 4, 4] freely registered parts
    clouds: Tensor,  # [n, N, 3]
    joint_type: int,
) -> ArticulatedTemplate:
    """Reduce free part poses to a tree of one-degree-of-freedom joints, in canonical object space (see above)."""
    num_parts = template.num_parts
    gaps = []
    for i, j in pair_index(num_parts).tolist():
        relative = invert_se3(pose[:, i]) @ pose[:, j]
        # What fits must fit from either side.
        gap = fit_screw(relative, template.points[template.label == j], joint_type).gap
        inverse = fit_screw(invert_se3(relative), template.points[template.label == i], joint_type).gap
        gaps.append(gap.median() + inverse.median())
    chain = extract_chain(-torch.stack(gaps), num_parts)

    into_object = {chain.root: torch.eye(4).to(pose)}
    axes, pivots, states = [], [], []
    for parent, child in zip(chain.parent, chain.child, strict=True):
        moving = template.points[template.label == child]
        axis, pivot, state, mean, _ = fit_screw(invert_se3(pose[:, parent]) @ pose[:, child], moving, joint_type)
        frame = into_object[parent]
        into_object[child] = frame @ mean
        axis = frame[:3, :3] @ axis
        if axes and axis @ axes[0] < 0:  # all joints of an object point one way, as far as they are parallel
            axis, state = -axis, -state
        axes.append(axis)
        pivots.append(transform_points(frame, pivot[None])[0])
        states.append(state)
    points = template.points.clone()
    for part in range(num_parts):
        mine = template.label == part
        points[mine] = transform_points(into_object[part], points[mine])

    frame = _principal_frame(points)
    points = transform_points(frame, points)
    axis = torch.stack(axes) @ frame[:3, :3].T
    pivot = transform_points(frame, torch.stack(pivots))
    # Where a pivot sits along its axis is a convention: the middle of the part it moves.
    center = torch.stack([points[template.label == child].mean(dim=0) for child in chain.child])
    pivot = pivot + ((center - pivot) * axis).sum(dim=1, keepdim=True) * axis

    joints = JointModel(chain, axis, pivot, joint_type)
    template, state = replace(template, points=points), torch.stack(states, dim=1)
    base = pose[:, chain.root] @ invert_se3(frame)
    few = template.thinned(clouds.shape[1])
    base, state, error = register_articulated(few, joints, clouds, base, state, (0.03, 0.02), 8)
    return ArticulatedTemplate(template, joints, base, state, error)


def _principal_frame(points: Tensor) -> Tensor:
    """Pose [4, 4] that moves points to their centre and principal axes (right-handed)."""
    center = points.mean(dim=0)
    axes = torch.linalg.eigh((points - center).T @ (points - center)).eigenvectors
    axes = axes * torch.sign(torch.linalg.det(axes))
    return se3(axes.T, -(axes.T @ center))
