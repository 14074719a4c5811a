"""Part discovery: find a category's parts and joints from unlabelled clouds alone, by registration.

1. *Rigid alignment*: each of a few typical clouds is registered to all others from every group rotation.
2. *Splits*: cut a typical cloud into K pieces, register every piece to every aligned cloud on its own, and reduce the
   motion between them to joints. Random cuts are first refined by giving each template point to the piece whose motion
   explains it best in all clouds: points that move together end up together. Slabs and restless points are taken as
   they are, since a small door would drown in that. From every split labels, joints and each cloud's proportions
   descend together (`instance_fit`), the better ones for longer. The winner reconstructs best with joints and
   proportions, which is what a wrong split cannot do.
   So far every typical cloud is on its own; the one whose template explains all clouds best, found by a search, stays.
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
from articulate_ssl.orientation import OrientationRange, mean_rotation
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
        references: Typical clouds that are tried as the template.
        starts: Random splits of each of them.
        jointed: The random splits that explain the clouds best, to which joints are fitted.
        rounds: Rounds of articulated search and descent on labels and joints.
        cuts: Also try slabs and restless points as splits.
        edge_hinges: Also try every revolute joint of the last splits along the edges of the part it moves.
        cycles: Cycles of descent in a round, and on the last splits; a third of them on every split and candidate.
        keep: Share of the clouds, best fitted first, that labels and joints are solved from.
        min_share: Splits with a part smaller than this share of the template are discarded.
        seed: Of the random splits.
    """

    clouds: int = 192
    split_clouds: int = 24
    search_clouds: int = 64
    points: int = 256
    dense_points: int = 1024
    references: int = 3
    starts: int = 12
    jointed: int = 4
    rounds: int = 2
    cuts: bool = True
    edge_hinges: bool = True
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
    object nearly maps to itself are elements of the rotation group; where orientations are limited, it is turned as the
    clouds are in the mean. State zero of every joint is near the clouds' mean.

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
    orientation: OrientationRange = OrientationRange(),  # noqa: B008 frozen
) -> ArticulatedTemplate:
    """Parts and joints of the category, registered to all the clouds.

    Args:
        orientation: How far objects are turned in the clouds.

    Raises:
        DiscoveryError: if no split into `num_parts` moving parts survives.
    """
    clouds = clouds[:, : options.dense_points].contiguous()
    generator = torch.Generator().manual_seed(options.seed)
    rotations = rotation_group(60).elements.to(clouds)
    rotations = rotations[orientation.contains(rotations)]
    few = clouds[:: max(1, len(clouds) // options.search_clouds)][: options.search_clouds]
    candidates = []
    for reference in clouds[choose_references(clouds, options.references)]:
        aligned = _aligned(reference, few, rotations, options)
        found = split_template(aligned, reference, num_parts, joint_type, options, generator, orientation)
        if found is not None:
            candidates.append(_registered(found, few, rotations, options, generator, orientation))
            log.info("template of %d: error %.4f", len(candidates), _trimmed(candidates[-1].error, options))
    if not candidates:
        raise DiscoveryError(
            f"part discovery found no part that moves in any split of {options.references} clouds: they do not show "
            f"{num_parts} parts that move on their own; check the category's number of parts, or allow more starts"
        )
    found = min(candidates, key=lambda candidate: _trimmed(candidate.error, options))

    for step in range(options.rounds):
        kept = found.error.argsort()[: max(1, int(options.keep * len(few)))]
        fit = InstanceFit(found.template, found.joints, found.base[kept], found.state[kept], generator)
        fit.optimise(few[kept], options.cycles, keep=options.keep)
        if _smallest_share(fit.template) < options.min_share:
            log.warning("round %d lost a part; keeping the parts of the round before", step + 1)
            break
        targets = few if step + 1 < options.rounds else clouds
        found = _registered(_as_found(fit, few[kept]), targets, rotations, options, generator, orientation)
        log.info("round %d: error %.4f", step + 1, _trimmed(found.error, options))
    if len(found.error) < len(clouds):
        found = _registered(found, clouds, rotations, options, generator, orientation)
    return found


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


def _registered(
    found: ArticulatedTemplate,
    clouds: Tensor,
    rotations: Tensor,
    options: DiscoveryOptions,
    generator: torch.Generator,
    orientation: OrientationRange,
) -> ArticulatedTemplate:
    """The template registered to the clouds: of a search's candidates, the one that fits best when stretched."""
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
    fit.optimise(copies, options.few_cycles, shared=False)
    # A hypothesis that leaves a part unexplained is to pay for it.
    error = fit.error(copies, softened=False).unflatten(0, base.shape[:2])
    error = error.masked_fill(~orientation.contains(base[..., :3, :3]), torch.inf)
    best = error.argmin(dim=1)
    rows = torch.arange(len(clouds), device=clouds.device)
    base, state = (value.unflatten(0, error.shape)[rows, best] for value in fit.model()[1:])
    fit = InstanceFit(found.template, joints, base, state, generator)
    fit.optimise(clouds, 2 * options.few_cycles, shared=False)
    _, base, state = fit.model()
    found = replace(found, base=base, state=state, error=fit.error(clouds, softened=False))
    return _turned_to_mean(found) if orientation.limited else found


def _turned_to_mean(found: ArticulatedTemplate) -> ArticulatedTemplate:
    """The same with the canonical space turned as the clouds are in the mean."""
    turn = mean_rotation(found.base[:, :3, :3])
    template = replace(found.template, points=found.template.points @ turn.T)
    joints = replace(found.joints, axis=found.joints.axis @ turn.T, pivot=found.joints.pivot @ turn.T)
    return replace(found, template=template, joints=joints, base=found.base @ se3(turn.T, turn.new_zeros(3)))


def _aligned(reference: Tensor, clouds: Tensor, rotations: Tensor, options: DiscoveryOptions) -> Tensor:
    """[n, N, 3] the clouds to which a template of one part fits best, in its frame."""
    coarse = max(64, options.points // 2)
    rigid, error = register_rigid(reference[:coarse], clouds[:, :coarse], rotations, keep=1)
    log.info("rigid alignment: median Chamfer-L1 %.4f", error[:, 0].median())
    best = error[:, 0].argsort()[: options.split_clouds]
    return transform_points(invert_se3(rigid[best, 0]), clouds[best])


def choose_references(clouds: Tensor, count: int) -> Tensor:
    """Indices of typical clouds that differ: medoids of clusters of the sorted distances to the centre.

    These are invariant to rotation, and tell an open object from a closed one.
    """
    radius = (clouds - clouds.mean(dim=1, keepdim=True)).norm(dim=-1).sort(dim=1).values
    distance = torch.cdist(radius, radius, p=1)
    # The first is the most typical of all, the others are ever less so.
    medoids = distance.sum(dim=1).argsort()[torch.linspace(0, len(clouds) - 1, count).long()]
    for _ in range(20):
        nearest = distance[medoids].argmin(dim=0)
        clusters = [(nearest == k).nonzero().squeeze(-1) for k in range(count)]
        moved = [
            c[distance[c][:, c].sum(dim=1).argmin()] if len(c) else m for c, m in zip(clusters, medoids, strict=True)
        ]
        if torch.equal(torch.stack(moved), medoids):
            break
        medoids = torch.stack(moved)
    return medoids.unique()


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
    orientation: OrientationRange = OrientationRange(),  # noqa: B008 frozen
) -> ArticulatedTemplate | None:
    """The split and joints that explain the clouds best when every cloud's object may stretch its parts.

    None if in every start a part is lost or does not move.
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
            found = fit_joints(labelled, pose, thin, joint_type, orientation)
            fits.append(InstanceFit(found.template, found.joints, found.base, found.state, generator))
    fits = _descended(fits, aligned, options.few_cycles, options)[:8]
    fits = _descended(fits, aligned, max(1, options.cycles // 2), options)[:3]
    if options.edge_hinges:
        fits += [other for fit in fits for other in hinged_at_edges(fit)]
        fits = _descended(fits, aligned, options.few_cycles, options)[:3]
    fits = _descended(fits, aligned, options.cycles, options)
    return _as_found(fits[0], aligned) if fits else None


def _descended(fits: list[InstanceFit], clouds: Tensor, cycles: int, options: DiscoveryOptions) -> list[InstanceFit]:
    """Those whose parts still move after a descent, best first."""
    for fit in fits:
        fit.optimise(clouds, cycles, keep=options.keep)
    moving = [fit for fit in fits if _smallest_share(fit.template) >= options.min_share and _least_motion(fit) > _STILL]
    return sorted(moving, key=lambda fit: _trimmed(fit.error(clouds), options))


def hinged_at_edges(fit: InstanceFit) -> list[InstanceFit]:
    """The fit with each joint line moved to each of the four edges of its part that run along it, states read anew.

    A small turn about a distant line looks like a large turn about a near one, and descent does not lead from one to
    the other.
    """
    joints = fit.model()[0]
    others = []
    if joints.joint_type != REVOLUTE:
        return others
    for j, child in enumerate(joints.chain.child):
        points = fit.template.points[fit.template.label == child]
        center = points.mean(dim=0)
        across = torch.linalg.svd(joints.axis[j][None]).Vh[1:]  # [2, 3] a frame of the plane the part turns in
        flat = (points - center) @ across.T
        across = torch.linalg.eigh(flat.T @ flat).eigenvectors.T @ across
        height = (points - center) @ across.T  # [m, 2]
        for u in (height[:, 0].amin(), height[:, 0].amax()):
            for v in (height[:, 1].amin(), height[:, 1].amax()):
                others.append(fit.rehinged(j, center + torch.stack([u, v]) @ across))
    return others


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
    orientation: OrientationRange = OrientationRange(),  # noqa: B008 frozen
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
    if orientation.limited:
        frame = se3(torch.eye(3).to(points), -points.mean(dim=0))
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
