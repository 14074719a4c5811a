"""Parts of one object that slide: cut out by how they slide, and looked for everywhere along that.

The discovery of a category lets objects stretch, and descends on labels, by which an object with small drawers loses
one. Here all clouds show one object: what slides alike in a frame that they have in common
(`discovery.proposals.slides`) is a part, and where it is in each cloud is one number, of which all can be tried.
Descent does not leave a place where the front of a drawer lies on another board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.collection import Collection
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.proposals import Scene, Split
from articulate_ssl.discovery.proposals.slides import Stood, slid_apart
from articulate_ssl.discovery.references import choose_references
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.slide_table import CAP, DIRECTIONS
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.observation import Observation

# All chosen, not tuned.
_CUT, _POINTS = 1024, 4096  # of a typical cloud, of which pieces are cut, and of every cloud that it is compared with
_REFERENCES = 3  # typical clouds. By one of them one chest's drawers went sideways (docs/experiments.md, step 328).
_COMPARED = 512  # points of a cloud, and of every part, with states tried
_FAR = 0.05  # normalised units: what is farther is no match
_STEP = 0.01  # of states, in normalised units
_MARGIN = 0.1  # how much farther than parts were seen they may be, in normalised units
_SWEEPS = 5  # through the joints of a cloud, at most


def slide_alone(joints: Joints) -> bool:
    """Whether parts slide, each against the base."""
    return joints.joint_type == PRISMATIC and set(joints.chain.parent) == {joints.chain.root}


def cut_by_slides(
    clouds: Tensor,  # [n, N, 3] of one object in any orientation
    num_parts: int,
    options: DiscoveryOptions,
) -> RegisteredShape:
    """Parts that slide along the axis of a common frame that typical clouds agree on; roughly registered to all.

    Raises:
        DiscoveryError: if clouds have no frame in common, or in none of them parts slide apart.
    """
    options, observation = replace(options, dense_points=_POINTS), Observation()
    collection = Collection.of(clouds, PRISMATIC, options, observation)
    if collection.frame is None:
        raise DiscoveryError("the clouds have no frame in common, along whose axes parts could slide")
    typical = collection.clouds[choose_references(collection.clouds, _REFERENCES), :_CUT]
    generator, clouds = collection.registrar.generator, collection.clouds
    scenes = [
        Scene(one, clouds, num_parts, PRISMATIC, options, observation, generator, framed=True, same_object=True)
        for one in typical
    ]
    axes = []
    for axis in range(3):
        ways = [Stood.of(scenes[0], direction) for direction in DIRECTIONS if direction.axis == axis]
        axes.append([_cheaper(*(slid_apart(scene, stood) for stood in ways)) for scene in scenes])
    along = min(axes, key=lambda found: sum(map(_cost, found)))
    best = min(along, key=_cost)
    if best is None:
        raise DiscoveryError(f"the clouds do not show {num_parts} parts that slide on their own")
    return collection.as_given(best)


def _cheaper(*splits: Split | None) -> RegisteredShape | None:
    """Of splits that there are, that which explains most."""
    return min((split.registered for split in splits if split is not None), key=_cost, default=None)


def _cost(found: RegisteredShape | None) -> float:
    return CAP if found is None else float(found.error.mean())


def slid_anew(
    placed: Placed,  # of n clouds, most of whose bodies are placed well
    shape: ArticulatedShape,  # fused from them
    surfaces: Sequence[Surface],  # n
) -> Placed:
    """The same lines, and in each cloud the states that explain it best, of all that may be, also upside down.

    If all stay, it is `placed` itself.
    """
    own = [Surface.of(shape.part(part).double().numpy()) for part in range(shape.num_parts)]
    trials = torch.arange(float(placed.state.min()) - _MARGIN, float(placed.state.max()) + _MARGIN, _STEP)
    over = _turned_over(placed, shape)
    base, state = placed.base.clone(), placed.state.clone()
    for row, surface in enumerate(surfaces):
        ways = [_best(placed.joints, body, state[row], own, surface, trials) for body in (base[row], over[row])]
        if ways[1][0] < ways[0][0]:
            base[row], state[row] = over[row], ways[1][1]
        else:
            moved = (ways[0][1] - state[row]).abs() > _STEP  # less descent sees by itself
            state[row] = torch.where(moved, ways[0][1], state[row])
    alike = torch.equal(base, placed.base) and torch.equal(state, placed.state)
    return placed if alike else replace(placed, base=base, state=state)


def _turned_over(placed: Placed, shape: ArticulatedShape) -> Tensor:  # [n, 4, 4]
    """Bodies that are turned by half about the way that drawers take, which chests nearly look alike by."""
    axis, body = placed.joints.axis[0], shape.part(placed.joints.chain.root).to(placed.base)
    middle = (body.amin(dim=0) + body.amax(dim=0)) / 2
    turn = 2 * axis[:, None] * axis - torch.eye(3).to(axis)
    return placed.base @ se3(turn, middle - turn @ middle)


def _best(
    joints: Joints,
    base: Tensor,  # [4, 4]
    state: Tensor,  # [J] from which the search starts
    parts: Sequence[Surface],
    surface: Surface,
    trials: Tensor,
) -> tuple[float, Tensor]:  # [J]
    """How far a cloud and the parts are from each other, and the states at which they are nearest.

    A point of the cloud is as far as the nearest part is.
    """
    body = np.linalg.inv(base.numpy())
    cloud, resting = surface.thinned(_COMPARED).moved(body), surface.moved(body)
    rest = parts[joints.chain.root].nearest(cloud, _FAR)
    there, back = [], []  # of every joint [trials, points], [trials]
    for child, axis in zip(joints.chain.child, joints.axis.numpy(), strict=True):
        own, thin = parts[child], parts[child].thinned(_COMPARED)
        shifts = [axis * float(trial) for trial in trials]
        there.append(np.stack([own.nearest(_shifted(cloud, -shift), _FAR) for shift in shifts]))
        back.append(np.array([resting.nearest(_shifted(thin, shift), _FAR).mean() for shift in shifts]))
    chosen = [int((trials - one).abs().argmin()) for one in state]
    for _ in range(_SWEEPS):
        before = chosen.copy()
        for joint in range(len(chosen)):
            others = [there[other][chosen[other]] for other in range(len(chosen)) if other != joint]
            costs = np.minimum(np.min([rest, *others], axis=0), there[joint]).mean(axis=1) + back[joint]
            chosen[joint] = int(costs.argmin())
        if chosen == before:
            break
    near = np.min([rest, *(own[index] for own, index in zip(there, chosen, strict=True))], axis=0).mean()
    cost = float(near) + sum(float(own[index]) for own, index in zip(back, chosen, strict=True))
    return cost, trials[chosen].to(state)


def _shifted(surface: Surface, shift: np.ndarray) -> Surface:
    return Surface(surface.points + shift, surface.normals)
