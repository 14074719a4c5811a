"""Part discovery: find a category's parts and joints from unlabelled clouds alone, by registration.

1. *Alignment*. Each of a few typical clouds is registered as a rigid template to all others from every rotation
   (`references`). Where joints slide and clouds have Manhattan frames, the whole collection is turned into one frame
   instead (`common_frame`).
2. *Propose, fit, select*, for each of the typical clouds. `proposals` cut it into K pieces; `bodies` register every
   piece to every aligned cloud on its own; `joint_fit` reduces the motion between them to joints; from there labels,
   joints and each cloud's proportions descend together (`instance_fit`), the better ones for longer (`selection`). The
   winner reconstructs best with joints and proportions, which is what a wrong split cannot do. So far every typical
   cloud is on its own; of those that agree about the collection (`agreement`) the one stays whose shape explains all
   clouds best, and by its joints (`joint_gain`).
3. *Rounds*: register the articulated shape to every cloud again (`registrar`; from many orientations, which is what
   rights clouds that the rigid template fitted upside down), then descend again on the clouds that fit.

No network, no label. It is to the staged recipe what the "zero iteration" is to the original.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

from torch import Tensor

from articulate_ssl.discovery.agreement import agreeing
from articulate_ssl.discovery.bodies import fit_bodies
from articulate_ssl.discovery.collection import Collection
from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.joint_fit import fit_joints
from articulate_ssl.discovery.joint_gain import best_by_joints
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.proposals import Scene, load_proposals
from articulate_ssl.discovery.references import aligned_to, alike, choose_references
from articulate_ssl.discovery.registered_shape import RegisteredShape, trimmed_mean
from articulate_ssl.discovery.registrar import Registrar
from articulate_ssl.discovery.selection import select
from articulate_ssl.ops.progress import Stage, announce
from articulate_ssl.shape.observation import Observation

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
    collection = Collection.of(clouds, joint_type, options, observation)
    clouds, few, framed = collection.clouds, collection.few, collection.frame is not None
    references = clouds[choose_references(clouds, options.references)]
    aligned = (
        alike(one, few, options) if framed else aligned_to(one, few, collection.rotations, options)
        for one in _announced(references, options)
    )
    scenes = (
        Scene(one, others, num_parts, joint_type, options, observation, collection.registrar.generator, framed)
        for one, others in zip(references, aligned, strict=True)
    )
    found = _best_reference(scenes, few, collection.registrar, num_parts)
    found = _rounds(found, clouds, few, collection.registrar)
    if len(found.error) < len(clouds):
        found = collection.registrar.register(found, clouds)
    _announce(_stages(options), options, "done")
    return collection.as_given(found)


def _best_reference(scenes: Iterator[Scene], few: Tensor, registrar: Registrar, num_parts: int) -> RegisteredShape:
    """Of the typical clouds, split and jointed, the one that explains `few` clouds best, and by its joints."""
    options, candidates = registrar.options, []
    for number, scene in enumerate(scenes, start=1):
        found = split(scene)
        if found is not None:
            _announce(2 * number - 1, options, f"template {number} of {options.references}, registration")
            candidates.append(registrar.register(found, few))
    if not candidates:
        raise DiscoveryError(
            f"part discovery found no part that moves in any split of {options.references} clouds: they do not show "
            f"{num_parts} parts that move on their own; check the category's number of parts, or allow more starts"
        )
    _announce(2 * options.references, options, "which template explains most")
    return best_by_joints(agreeing(candidates, few), few, options)


def split(scene: Scene) -> RegisteredShape | None:
    """The split and joints that explain the clouds best when every cloud's object may stretch its parts.

    None if in every split a part is lost or does not move.
    """
    splits = [one for propose in load_proposals(scene.options.proposals) for one in propose(scene)]
    log.info("joints of %d splits", len(splits))
    # Who proposes how pieces move, too, has seen more than free registration of the pieces would.
    jointed = [one.registered for one in splits if one.registered is not None]
    if not jointed:
        turned = not scene.observation.orientation.limited
        jointed = [fit_joints(bodies, scene.thin, scene.joint_type, turned) for bodies in fit_bodies(splits, scene)]
    best = select([found.fit(scene.generator) for found in jointed], scene.aligned, scene.options)
    return None if best is None else _found(best, scene.aligned)


def _rounds(found: RegisteredShape, clouds: Tensor, few: Tensor, registrar: Registrar) -> RegisteredShape:
    """Descend on the clouds that fit, register again; the last time to all clouds.

    Those whose joints are at an end of what was sought do not count: of ovens most are turned over, and what is sought
    next would become wider from round to round (docs/experiments.md, step 325).
    """
    options = registrar.options
    for step in range(options.rounds):
        _announce(2 * options.references + 1 + step, options, f"round {step + 1} of {options.rounds}")
        kept = found.best(options.kept(len(few)))
        fit = found.fit(registrar.generator, kept)
        fit.optimise(few[kept], options.cycles, keep=options.keep, owing=True)
        if fit.shape.smallest_share < options.min_share:
            log.warning("round %d lost a part; keeping the parts of the round before", step + 1)
            break
        targets = few if step + 1 < options.rounds else clouds
        found = registrar.register(_found(fit, few[kept]), targets)
        log.info("round %d: error %.4f", step + 1, trimmed_mean(found.error, options))
    return found


def _found(fit: InstanceFit, clouds: Tensor) -> RegisteredShape:
    found = RegisteredShape.of(fit, clouds)
    return replace(found, shape=found.shape.with_centred_pivots())


def _stages(options: DiscoveryOptions) -> int:
    """Of roughly the same length: two for every template, one to compare them, one for every round."""
    return 2 * options.references + 1 + options.rounds


def _announce(done: int, options: DiscoveryOptions, name: str) -> None:
    announce(log, Stage("part discovery", name, done, _stages(options)))


def _announced(references: Tensor, options: DiscoveryOptions) -> Iterator[Tensor]:
    """The typical clouds, one after the other."""
    for number, one in enumerate(references):
        _announce(2 * number, options, f"template {number + 1} of {options.references}")
        yield one
