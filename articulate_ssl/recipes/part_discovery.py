"""Part discovery: find a category's parts and joints from unlabelled clouds alone, by registration.

1. *Rigid alignment*: one typical cloud is registered to all others from every group rotation.
2. *Splits*: cut the typical cloud into K pieces, register every piece to every aligned cloud on its own, and reduce the
   motion between them to joints. Random cuts are first refined by giving each template point to the piece whose motion
   explains it best in all clouds: points that move together end up together. Slabs and restless points are taken as
   they are, since a small door would drown in that. From every split labels, joints and each cloud's proportions
   descend together (`instance_fit`), the better ones for longer. The winner reconstructs best with joints and
   proportions, which is what a wrong split cannot do.
3. *Rounds*: search every cloud again with the articulated template, from many orientations (this is what rights clouds
   that the rigid template fitted upside down), then descend again on the clouds that fit.

No network, no label. It is to the staged recipe what the "zero iteration" is to the original.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.groups import rotation_group
from articulate_ssl.kinematic_chain import KinematicChain, extract_chain, pair_index
from articulate_ssl.ops.chamfer import nearest_squared_distance
from articulate_ssl.recipes.instance_fit import InstanceFit, smooth_labels
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
from datamodules.geometry import REVOLUTE, invert_se3, se3, transform_points

# Shares of the template that slabs and restless points take.
_SLABS = (0.1, 0.2)
_UNREST = (0.08, 0.15, 0.3)
_STILL = 0.01  # in normalised units: what moves less is not a part

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
        rounds: Rounds of articulated search and descent on labels and joints.
        cuts: Also try slabs and restless points as splits.
        cycles: Cycles of descent in a round, and on the last splits; a third of them on every split and candidate.
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
    cuts: bool = True
    cycles: int = 12
    keep: float = 0.75
    min_share: float = 0.05
    seed: int = 0

    @property
    def few_cycles(self) -> int:
        """Cycles of descent where there are many candidates."""
        return max(1, self.cycles // 3)


@dataclass(frozen=True)
class ArticulatedTemplate:
    """A category's labelled template with joints, registered to n clouds.

    Canonical object space has the template's principal axes as coordinate axes, so that the half-turns under which an
    object nearly maps to itself are elements of the rotation group. State zero of every joint is near the clouds' mean.

    Attributes:
        template: [T] labelled points.
        joints: Joint lines and kinematic chain.
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J] joint states.
        error: [n] distance of every cloud to its reconstruction, stretched to its proportions (`InstanceFit.error`).
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
    generator = torch.Generator().manual_seed(options.seed)
    reference = clouds[choose_reference(clouds)]
    rotations = rotation_group(60).elements.to(clouds)
    coarse = max(64, options.points // 2)
    few = clouds[:: max(1, len(clouds) // options.search_clouds)][: options.search_clouds]
    rigid, error = register_rigid(reference[:coarse], few[:, :coarse], rotations, keep=1)
    log.info("rigid alignment: median Chamfer-L1 %.4f", error[:, 0].median())

    best_aligned = error[:, 0].argsort()[: options.split_clouds]
    aligned = transform_points(invert_se3(rigid[best_aligned, 0]), few[best_aligned])
    found = split_template(aligned, reference, num_parts, joint_type, options, generator)
    log.info("best split: error %.4f", found.error.mean())

    for step in range(options.rounds):
        base, state, error = _search(found, few, rotations, options.few_cycles, generator)
        kept = error.argsort()[: max(1, int(options.keep * len(few)))]
        fit = InstanceFit(found.template, found.joints, base[kept], state[kept], generator)
        fit.optimise(few[kept], options.cycles, keep=options.keep)
        if _smallest_share(fit.template) < options.min_share:
            log.warning("round %d lost a part; keeping the parts of the round before", step + 1)
            break
        found = _as_found(fit, few[kept])
        log.info("round %d: error %.4f of the kept clouds", step + 1, found.error.mean())
    base, state, error = _search(found, clouds, rotations, options.few_cycles, generator)
    return replace(found, base=base, state=state, error=error)


def _as_found(fit: InstanceFit, clouds: Tensor) -> ArticulatedTemplate:
    joints, base, state = fit.model()
    error = fit.error(clouds, softened=False)
    return ArticulatedTemplate(fit.template, _centred_pivots(joints, fit.template), base, state, error)


def _centred_pivots(joints: JointModel, template: LabelledTemplate) -> JointModel:
    """Where a pivot sits along its axis is a convention: the middle of the part it moves."""
    center = torch.stack([template.points[template.label == child].mean(dim=0) for child in joints.chain.child])
    along = ((center - joints.pivot) * joints.axis).sum(dim=1, keepdim=True)
    return replace(joints, pivot=joints.pivot + along * joints.axis)


def _smallest_share(template: LabelledTemplate) -> float:
    counts = torch.bincount(template.label, minlength=template.num_parts)
    return float(counts.min() / counts.sum())


def _search(
    found: ArticulatedTemplate, clouds: Tensor, rotations: Tensor, cycles: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Base poses, joint states and errors of the clouds: of the candidates, the one that fits best when stretched."""
    spread = 1.5 * found.state.std(dim=0)
    # The middle, and every combination of either side.
    states = torch.cartesian_prod(*torch.stack([-spread, spread], dim=-1)).view(-1, len(spread))
    states = torch.cat([torch.zeros_like(states[:1]), states])
    limits = torch.quantile(found.state, torch.tensor([0.05, 0.95]).to(states), dim=0)
    margin = 0.15 * (limits[1] - limits[0])
    joints = replace(found.joints, limits=torch.stack([limits[0] - margin, limits[1] + margin], dim=-1))
    base, state, _ = search_articulated(found.template, joints, clouds, rotations, states)
    copies = clouds.repeat_interleave(base.shape[1], dim=0)
    fit = InstanceFit(found.template, joints, base.flatten(0, 1), state.flatten(0, 1), generator)
    fit.optimise(copies, cycles, shared=False)
    # A hypothesis that leaves a part unexplained is to pay for it.
    error = fit.error(copies, softened=False).unflatten(0, base.shape[:2])
    best = error.argmin(dim=1)
    rows = torch.arange(len(clouds), device=clouds.device)
    base, state = (value.unflatten(0, error.shape)[rows, best] for value in fit.model()[1:])
    fit = InstanceFit(found.template, joints, base, state, generator)
    fit.optimise(clouds, 2 * cycles, shared=False)
    return *fit.model()[1:], fit.error(clouds, softened=False)


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


def slab_cuts(template: Tensor, num_parts: int, generator: torch.Generator) -> list[Tensor]:
    """[T] labels that part a slab from the rest, at either end of each principal axis; doors are slabs."""
    height = template @ _principal_frame(template)[:3, :3].T
    slabs = [sign * h for h in height.T for sign in (-1, 1)]
    return [_cut_off(template, slab, share, num_parts, generator) for slab in slabs for share in _SLABS]


def unrest_cuts(
    aligned: Tensor, template: Tensor, num_parts: int, cycles: int, generator: torch.Generator
) -> list[Tensor]:
    """[T] labels that part the points whose distance to the clouds varies most when nothing but the whole can move."""
    whole = LabelledTemplate(template, torch.zeros(len(template), dtype=torch.long, device=template.device), 1)
    nothing = template.new_zeros(0, 3)
    joints = JointModel(KinematicChain(1, 0, (), ()), nothing, nothing, REVOLUTE)
    pose = torch.eye(4).to(template).expand(len(aligned), 4, 4)
    fit = InstanceFit(whole, joints, pose, template.new_zeros(len(aligned), 0), generator)
    fit.optimise(aligned, cycles, shared=False)
    unrest = nearest_squared_distance(fit.posed(), aligned).sqrt().std(dim=0)
    near = torch.cdist(template, template).topk(min(24, len(template)), largest=False).indices
    unrest = unrest[near].mean(dim=1)
    return [_cut_off(template, unrest, share, num_parts, generator) for share in _UNREST]


def _cut_off(template: Tensor, height: Tensor, share: float, num_parts: int, generator: torch.Generator) -> Tensor:
    """Part 0 is all but the highest share, which is cut at random into the others."""
    high = height > height.quantile(1 - share)
    label = torch.zeros(len(template), dtype=torch.long, device=template.device)
    label[high] = 1 if num_parts == 2 else 1 + random_split(template[high], num_parts - 1, generator)
    return label


def split_template(
    aligned: Tensor,  # [n, N, 3]
    template: Tensor,  # [T, 3]
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
    generator: torch.Generator,
) -> ArticulatedTemplate:
    """The split and joints that explain the clouds best when every cloud's object may stretch its parts.

    Raises:
        DiscoveryError: if in every start a part is lost or does not move.
    """
    thin = aligned[:, : options.points]
    bodies = []
    for _ in range(options.starts):
        label = random_split(template, num_parts, generator)
        labelled, pose = _moving_bodies(template, label, num_parts, thin, relabelled=True)
        if _smallest_share(labelled) >= options.min_share:
            bodies.append((_trimmed(chamfer_l1(thin, labelled.posed(pose)), options), labelled, pose))
    bodies = [(labelled, pose) for _, labelled, pose in sorted(bodies, key=lambda body: body[0])[: options.jointed]]
    cuts = []
    if options.cuts:
        cuts = slab_cuts(template, num_parts, generator)
        cuts += unrest_cuts(aligned, template, num_parts, options.few_cycles, generator)
    for label in cuts:
        bodies.append(_moving_bodies(template, label, num_parts, thin, relabelled=False))

    fits = []
    for labelled, pose in bodies:
        if _smallest_share(labelled) >= options.min_share:
            found = fit_joints(labelled, pose, thin, joint_type)
            fits.append(InstanceFit(found.template, found.joints, found.base, found.state, generator))
    for cycles, survivors in ((options.few_cycles, 8), (max(1, options.cycles // 2), 3), (options.cycles, 1)):
        for fit in fits:
            fit.optimise(aligned, cycles, keep=options.keep)
        fits = [
            fit for fit in fits if _smallest_share(fit.template) >= options.min_share and _least_motion(fit) > _STILL
        ]
        fits = sorted(fits, key=lambda fit: _trimmed(fit.error(aligned), options))[:survivors]
    if not fits:
        raise DiscoveryError(
            f"part discovery found no part that moves in any of {len(bodies)} starts: the clouds do not show "
            f"{num_parts} parts that move on their own; check the category's number of parts, or allow more starts"
        )
    return _as_found(fits[0], aligned)


def _least_motion(fit: InstanceFit) -> float:
    """Standard deviation over the clouds of how far a joint moves the part on it, of the joint that moves least."""
    joints, _, state = fit.model()
    spread = state.std(dim=0)
    if joints.joint_type == REVOLUTE:
        for j, child in enumerate(joints.chain.child):
            offset = fit.template.points[fit.template.label == child] - joints.pivot[j]
            spread[j] *= torch.linalg.cross(offset, joints.axis[j].expand_as(offset)).norm(dim=1).mean()
    return float(spread.min())


def _moving_bodies(
    template: Tensor, label: Tensor, num_parts: int, clouds: Tensor, relabelled: bool
) -> tuple[LabelledTemplate, Tensor]:
    """Register the pieces of a template to aligned clouds, each on its own; `relabelled`, give points to the pieces."""
    labelled = LabelledTemplate(template, label, num_parts)
    pose = torch.eye(4).to(template).expand(len(clouds), num_parts, 4, 4)
    for step, scale in enumerate(torch.logspace(-1.1, -1.7, 16).tolist()):
        pose = update_poses(labelled.thinned(clouds.shape[1]), pose, clouds, scale)
        if relabelled and step % 2 == 1:
            labelled = relabel(labelled, pose, clouds, cap=4 * scale)
    return labelled, pose


def _trimmed(error: Tensor, options: DiscoveryOptions) -> float:
    """Mean error of the clouds that fit best: some are aligned wrongly."""
    return float(error.sort().values[: max(1, int(options.keep * len(error)))].mean())


def relabel(
    template: LabelledTemplate,
    pose: Tensor,  # [n, K, 4, 4]
    clouds: Tensor,  # [n, N, 3]
    cap: float,  # distances beyond this count as this
) -> LabelledTemplate:
    """Give every template point to the part whose motion brings it closest to the clouds, smoothed over neighbours."""
    cost = template.points.new_zeros(len(template.points), template.num_parts)
    for part in range(template.num_parts):
        moved = transform_points(pose[:, part], template.points)  # [n, T, 3]
        for cloud, points in zip(clouds.split(32), moved.split(32), strict=True):
            cost[:, part] += torch.cdist(points, cloud).amin(dim=2).clamp(max=cap).sum(dim=0)
    return replace(template, label=smooth_labels(template.points, cost))


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
    template, state = replace(template, points=points), torch.stack(states, dim=1)
    joints = _centred_pivots(JointModel(chain, axis, pivot, joint_type), template)
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
