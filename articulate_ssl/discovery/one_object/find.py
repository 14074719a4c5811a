"""From clouds of one object in several joint states to its parts, joints, and where they are in every cloud.

1. *Coarse*: part discovery as for a category, with less effort, because all clouds show the same object. What slides
   is first cut out by how it slides (`slide_search`).
2. *Fine*, a few rounds: every point goes to the part with which it stays on the surface of all other clouds, there on
   points that are of the same part (`moving_labels`), then poses, states and joint lines of all clouds are adjusted
   together (`adjustment`).
3. *Once more*, with all clouds placed alike (`stand_alike`); where it has one hinge, from where else that may be, too
   (`hinge_search`), and where parts slide, from where else they may be (`slide_search`). What fits better stays.
4. *Fuse*: what all clouds show of a part, in canonical object space.

That clouds show the same object is known here: the paper's method, and `discover`, do not use it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError, discover
from articulate_ssl.discovery.one_object.adjustment import Placed, adjusted
from articulate_ssl.discovery.one_object.hinge_search import has_one_hinge, turned_anew
from articulate_ssl.discovery.one_object.moving_labels import CAP, agreed, believed, moving_costs
from articulate_ssl.discovery.one_object.slide_search import cut_by_slides, slid_anew, slide_alone
from articulate_ssl.discovery.one_object.stand_alike import placed_alike, sought_alike
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.ops.progress import Stage, announce
from articulate_ssl.shape.articulated_shape import ArticulatedShape

MIN_CLOUDS = 8  # as a choice: fewer were not tried
_ROUNDS = 3  # of labels and adjustment; the third gained .003 of IoU on a chest, the second .07
_POINTS = 1024  # of every cloud in these rounds
LABELLED = 2048  # of every cloud in the end, if not asked otherwise
# Coarse discovery, in a sixth of the time that a category takes.
_EFFORT = {"starts": 6, "rounds": 1, "cycles": 6}
_REFERENCES = (1, 3)  # tried as the template; more where one leaves too much unexplained
# Share of the points that may lie off the other clouds: .01 to .12 where parts were right, .69 where clouds were of two
# objects.
_EXPLAINED = 0.15
_COARSE_STAGES = 8  # what coarse discovery takes as long as, in rounds
_STAGES = _COARSE_STAGES + _ROUNDS + 1

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OneObject:
    """One object, and how it is in each of n clouds.

    Attributes:
        shape: Fused points, evenly spread over each part; joints, whose limits are the lowest and highest state seen.
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J] joint states, relative to the canonical object shape.
        label: [n, N] part of the leading points of every cloud.
        probability: [n, N, K] of every part for them.
        misfit: [n, N] how far they are from the other clouds on average, moved with the likeliest part; normalised
            units, capped.
    """

    shape: ArticulatedShape
    base: Tensor
    state: Tensor
    label: Tensor
    probability: Tensor
    misfit: Tensor

    @property
    def unexplained(self) -> float:
        """Share of the points that lie off the surface of the other clouds whichever part they are moved with."""
        return float((self.misfit > CAP / 2).double().mean())

    @property
    def explained(self) -> bool:
        """Whether so few points are off as where parts were right."""
        return self.unexplained < _EXPLAINED


def find_one_object(
    clouds: Tensor,  # [n, N, 3] complete, any orientation, one scale; farthest-point order, normalised as in training
    num_parts: int,
    joint_type: int,
    part_points: int = 1024,
    seed: int = 0,
    labelled: int = LABELLED,
) -> OneObject:
    """Parts and joints of the object that all clouds show, and its pose and joint states in each of them.

    Args:
        part_points: Fused points of each part.
        labelled: How many points of every cloud get a label in the end.
        seed: Of everything random.

    Raises:
        DiscoveryError: if there are too few clouds, or no split into `num_parts` moving parts survives.
    """
    if len(clouds) < MIN_CLOUDS:
        raise DiscoveryError(f"{len(clouds)} clouds of one object, at least {MIN_CLOUDS} are needed: scan more states")
    surfaces = [Surface.of(cloud) for cloud in clouds.double().numpy()]
    best, refused = None, None
    for coarse in _coarse_ways(clouds.float(), num_parts, joint_type, seed):
        try:
            found = _attempt(coarse, surfaces, part_points, labelled)
        except DiscoveryError as error:
            refused = error
            continue
        if best is None or found.unexplained < best.unexplained:
            best = found
        if best.explained:
            break
    _announce(_STAGES, "done")
    if best is None:
        raise refused
    return best


def _coarse_ways(clouds: Tensor, num_parts: int, joint_type: int, seed: int) -> Iterator[Callable[[], RegisteredShape]]:
    """Ways to split the object, the likeliest first."""
    efforts = [DiscoveryOptions(clouds=len(clouds), references=r, seed=seed, **_EFFORT) for r in _REFERENCES]
    if joint_type == PRISMATIC:
        yield partial(cut_by_slides, clouds, num_parts, efforts[0])
    for effort in efforts:
        yield partial(discover, clouds, num_parts, joint_type, effort)


def _attempt(
    coarse: Callable[[], RegisteredShape], surfaces: list[Surface], part_points: int, labelled: int
) -> OneObject:
    """One way to split the object, made exact."""
    _announce(0, "parts")
    found = coarse()
    joints = found.shape.joints
    joints = replace(joints, axis=joints.axis.double(), pivot=joints.pivot.double())
    placed = Placed(joints, found.base.double(), found.state.double())
    return _asked_again(refined(surfaces, placed, part_points, labelled=labelled), surfaces, part_points)


def _asked_again(one: OneObject, surfaces: list[Surface], part_points: int) -> OneObject:
    """The object with all clouds placed alike, hinge or slides where a search leads, if its clouds then fit better."""
    placed = Placed(replace(one.shape.joints, limits=None), one.base, one.state)
    if has_one_hinge(placed.joints):
        alike = placed_alike(placed, one.shape, surfaces)
        anew = turned_anew(alike, surfaces) or alike
    else:
        anew = sought_alike(placed, one.shape, surfaces)
        if slide_alone(placed.joints):
            anew = slid_anew(anew, one.shape, surfaces)
    if anew is placed:
        return one
    try:
        other = refined(surfaces, anew, part_points, labelled=one.label.shape[1])
    except DiscoveryError:
        return one
    return min((one, other), key=lambda found: float(found.misfit.mean()))


def refined(
    surfaces: list[Surface],  # n clouds of one object
    placed: Placed,  # float64, roughly
    part_points: int,
    votes: np.ndarray | None = None,  # [n, N, K] shares of what else says which parts their leading points are of
    labelled: int = LABELLED,
) -> OneObject:
    """Labels and adjustment in turn, then the object. With votes, parts keep their names, and a base its own.

    Raises:
        DiscoveryError: if a part has lost its points.
    """
    thin = [surface.thinned(_POINTS) for surface in surfaces]
    for step in range(_ROUNDS):
        _announce(_COARSE_STAGES + step, f"round {step + 1} of {_ROUNDS}")
        if votes is None:
            label = _kept_parts(_labelled(surfaces, placed, _POINTS)[1])
            # Bodies have more surface than what moves on them.
            placed = rooted_at(placed, int(np.bincount(label.ravel()).argmax()))
        else:  # at first places are too rough to say anything
            probability = _labelled(surfaces, placed, _POINTS, votes)[1] if step else votes[:, :_POINTS]
            label = _kept_parts(probability)
        placed = adjusted(placed, thin, label)
    _announce(_COARSE_STAGES + _ROUNDS, "fusing")
    cost, probability = _labelled(surfaces, placed, labelled, votes)
    label = _kept_parts(probability)
    return _fused(placed, surfaces, label, probability, cost, part_points)


def _announce(done: int, name: str) -> None:
    announce(log, Stage("one object", name, done, _STAGES))


def _labelled(
    surfaces: list[Surface], placed: Placed, count: int, votes: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Costs and probabilities of every part [n, count, K] for the leading points of every cloud."""
    count = min(count, len(surfaces[0].points))
    cost = moving_costs(surfaces, placed.pose.numpy(), count)
    said = believed(cost, None if votes is None else votes[:, :count])
    return cost, agreed([surface.thinned(count) for surface in surfaces], placed.pose.numpy(), said)


def _kept_parts(probability: np.ndarray) -> np.ndarray:
    """[n, N] the likeliest parts.

    Raises:
        DiscoveryError: if a part has lost its points.
    """
    label = probability.argmax(axis=-1)
    count = np.bincount(label.ravel(), minlength=probability.shape[-1])
    if count.min() < len(label):  # less than a point a cloud
        raise DiscoveryError(
            f"only {int((count >= len(label)).sum())} of {len(count)} parts are left: the clouds do not show so many "
            "parts that move on their own; ask for fewer, or scan more states"
        )
    return label


def rooted_at(placed: Placed, root: int) -> Placed:
    """Take another part for the base, where that changes no motion: of two parts, or of parts that slide one way.

    What slides slides against any other part: the one that moved least in the clouds need not be the body.
    """
    joints, chain = placed.joints, placed.joints.chain
    sliding = slide_alone(joints)
    if chain.root == root or not (sliding or chain.num_parts == 2):
        return placed
    children = tuple(part for part in range(chain.num_parts) if part != root)
    star = KinematicChain(chain.num_parts, root, (root,) * len(children), children)
    if not sliding:
        return Placed(replace(joints, chain=star), placed.pose[:, root], -placed.state)
    sign = (joints.axis @ joints.axis[0]).sign()
    axis = torch.nn.functional.normalize((sign[:, None] * joints.axis).mean(dim=0), dim=-1)
    height = torch.zeros(len(placed.base), chain.num_parts).to(placed.state)
    height[:, list(chain.child)] = sign * placed.state
    pivot = torch.zeros(chain.num_parts, 3).to(joints.pivot)
    pivot[list(chain.child)] = joints.pivot
    lines = replace(joints, chain=star, axis=axis.expand(len(children), 3).clone(), pivot=pivot[list(children)])
    return Placed(lines, placed.pose[:, root], height[:, list(children)] - height[:, [root]])


def _fused(
    placed: Placed,
    surfaces: list[Surface],
    label: np.ndarray,  # [n, N]
    probability: np.ndarray,  # [n, N, K]
    cost: np.ndarray,  # [n, N, K]
    part_points: int,
) -> OneObject:
    """All clouds' points in canonical object space, but for those that no part explains."""
    misfit = np.take_along_axis(cost, label[..., None], axis=-1)[..., 0]
    back = np.linalg.inv(placed.pose.numpy())
    rows = np.arange(len(surfaces))[:, None]
    points = np.stack([s.points[: label.shape[1]] for s in surfaces])
    points = np.einsum("nmij,nmj->nmi", back[rows, label][..., :3, :3], points) + back[rows, label][..., :3, 3]
    explained = misfit < CAP / 2
    parts = []
    for part in range(probability.shape[-1]):
        mine = (label == part) & explained
        own = points[mine if mine.any() else label == part]
        # Farthest-point sampling takes time for each point that it chooses from.
        own = np.random.default_rng(0).permutation(own)[: 8 * part_points]
        parts.append(np.resize(own[farthest_point_order(own, min(part_points, len(own)))], (part_points, 3)))
    shape = ArticulatedShape(
        torch.from_numpy(np.concatenate(parts)),
        torch.arange(len(parts)).repeat_interleave(part_points),
        placed.joints,
    ).with_centred_pivots()
    limits = torch.stack([placed.state.amin(dim=0), placed.state.amax(dim=0)], dim=-1)
    shape = replace(shape, joints=replace(shape.joints, limits=limits))
    return OneObject(
        shape,
        placed.base,
        placed.state,
        torch.from_numpy(label),
        torch.from_numpy(probability),
        torch.from_numpy(misfit),
    )
