"""Part discovery: find a category's parts and joints from unlabelled clouds alone, by registration.

1. *Rigid alignment* (`references`): each of a few typical clouds is registered to all others from every rotation.
2. *Propose, fit, select*, for each of them. `proposals` cut it into K pieces; `bodies` register every piece to every
   aligned cloud on its own; `joint_fit` reduces the motion between them to joints; from there labels, joints and each
   cloud's proportions descend together (`instance_fit`), the better ones for longer (`selection`). The winner
   reconstructs best with joints and proportions, which is what a wrong split cannot do. So far every typical cloud is
   on its own; the one whose shape explains all clouds best, found by a search, stays.
3. *Rounds*: search every cloud again with the articulated shape, from many orientations (this is what rights clouds
   that the rigid template fitted upside down), then descend again on the clouds that fit.

No network, no label. It is to the staged recipe what the "zero iteration" is to the original.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.bodies import fit_bodies
from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.joint_fit import fit_joints
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.proposals import Scene, load_proposals
from articulate_ssl.discovery.references import aligned_to, choose_references
from articulate_ssl.discovery.registered_shape import RegisteredShape, trimmed_mean
from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.discovery.selection import select
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.shape.observation import Observation

_STATE_STARTS = 1.5  # standard deviations of the states, on either side of their middle, from which a search starts

log = logging.getLogger(__name__)


class DiscoveryError(RuntimeError):
    """The clouds do not show the parts that were asked for."""


def discover(
    clouds: Tensor,  # [n, N, 3] in any orientation
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
    observation: Observation = Observation(),  # noqa: B008 frozen
) -> RegisteredShape:
    """Parts and joints of the category, registered to all the clouds.

    Raises:
        DiscoveryError: if no split into `num_parts` moving parts survives.
    """
    clouds = clouds[:, : options.dense_points].contiguous()
    generator = torch.Generator().manual_seed(options.seed)
    rotations = rotation_group(60).elements.to(clouds)
    registrar = Registrar(rotations[observation.orientation.contains(rotations)], options, generator, observation)
    few = clouds[:: max(1, len(clouds) // options.search_clouds)][: options.search_clouds]
    found = _best_reference(clouds, few, num_parts, joint_type, registrar)
    found = _rounds(found, clouds, few, registrar)
    if len(found.error) < len(clouds):
        found = registrar.register(found, clouds)
    return found


class Registrar(NamedTuple):
    """Registers a shape to clouds: of a search's candidates, the one that fits best when stretched.

    Attributes:
        rotations: [H, 3, 3] from which clouds are searched.
        options: How much work to do.
        generator: Of everything random.
        observation: How far objects are turned.
    """

    rotations: Tensor
    options: DiscoveryOptions
    generator: torch.Generator
    observation: Observation

    def register(self, found: RegisteredShape, clouds: Tensor) -> RegisteredShape:
        """The shape of a registration, registered to other clouds [n, N, 3]."""
        few_cycles = self.options.few_cycles
        shape = found.limited()
        base, state, _ = search_articulated(shape, clouds, self.rotations, _state_starts(found.state))
        copies = clouds.repeat_interleave(base.shape[1], dim=0)
        fit = InstanceFit(shape, base.flatten(0, 1), state.flatten(0, 1), self.generator)
        fit.optimise(copies, few_cycles, shared=False)
        # A hypothesis that leaves a part unexplained is to pay for it.
        error = fit.error(copies, softened=False).unflatten(0, base.shape[:2])
        best = self.observation.ranked(error, base[..., :3, :3]).argmin(dim=1)
        rows = torch.arange(len(clouds), device=clouds.device)
        base, state = (value.unflatten(0, error.shape)[rows, best] for value in (fit.base, fit.state))
        fit = InstanceFit(shape, base, state, self.generator)
        fit.optimise(clouds, 2 * few_cycles, shared=False)
        registered = replace(RegisteredShape.of(fit, clouds), shape=found.shape)
        return registered.turned_to_mean() if self.observation.orientation.limited else registered


def _best_reference(
    clouds: Tensor, few: Tensor, num_parts: int, joint_type: int, registrar: Registrar
) -> RegisteredShape:
    """Of the typical clouds, split and jointed, the one that explains `few` clouds best."""
    options, candidates = registrar.options, []
    for reference in clouds[choose_references(clouds, options.references)]:
        aligned = aligned_to(reference, few, registrar.rotations, options)
        scene = Scene(reference, aligned, num_parts, joint_type, options, registrar.observation, registrar.generator)
        found = split(scene)
        if found is not None:
            candidates.append(registrar.register(found, few))
            log.info("template of %d: error %.4f", len(candidates), _error(candidates[-1], options))
    if not candidates:
        raise DiscoveryError(
            f"part discovery found no part that moves in any split of {options.references} clouds: they do not show "
            f"{num_parts} parts that move on their own; check the category's number of parts, or allow more starts"
        )
    return min(candidates, key=lambda candidate: _error(candidate, options))


def split(scene: Scene) -> RegisteredShape | None:
    """The split and joints that explain the clouds best when every cloud's object may stretch its parts.

    None if in every split a part is lost or does not move.
    """
    splits = [one for propose in load_proposals(scene.options.proposals) for one in propose(scene)]
    turned = not scene.observation.orientation.limited
    jointed = [fit_joints(bodies, scene.thin, scene.joint_type, turned) for bodies in fit_bodies(splits, scene)]
    fits = [InstanceFit(found.shape, found.base, found.state, scene.generator) for found in jointed]
    best = select(fits, scene.aligned, scene.options)
    return None if best is None else _found(best, scene.aligned)


def _rounds(found: RegisteredShape, clouds: Tensor, few: Tensor, registrar: Registrar) -> RegisteredShape:
    """Descend on the clouds that fit, search again; the last search is in all clouds."""
    options = registrar.options
    for step in range(options.rounds):
        kept = found.error.argsort()[: options.kept(len(few))]
        fit = InstanceFit(found.shape, found.base[kept], found.state[kept], registrar.generator)
        fit.optimise(few[kept], options.cycles, keep=options.keep)
        if fit.shape.smallest_share < options.min_share:
            log.warning("round %d lost a part; keeping the parts of the round before", step + 1)
            break
        targets = few if step + 1 < options.rounds else clouds
        found = registrar.register(_found(fit, few[kept]), targets)
        log.info("round %d: error %.4f", step + 1, _error(found, options))
    return found


def _found(fit: InstanceFit, clouds: Tensor) -> RegisteredShape:
    found = RegisteredShape.of(fit, clouds)
    return replace(found, shape=found.shape.with_centred_pivots())


def _error(found: RegisteredShape, options: DiscoveryOptions) -> float:
    return trimmed_mean(found.error, options.kept(len(found.error)))


def _state_starts(state: Tensor) -> Tensor:
    """The middle, and every combination of either side: [1 + 2^J, J]."""
    spread = _STATE_STARTS * state.std(dim=0)
    states = torch.cartesian_prod(*torch.stack([-spread, spread], dim=-1)).view(-1, len(spread))
    return torch.cat([torch.zeros_like(states[:1]), states])
