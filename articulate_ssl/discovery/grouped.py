"""Part discovery in the multi-state setting: which clouds show the same object is known, and templates are objects.

It is how people scan, and an easier problem than the paper's: no result of it belongs beside one from single clouds
without its name. What is used is which recordings are of one object, no label.

1. Of a few typical objects parts and joints are found from all their clouds (`one_object`).
2. Those that were understood best are brought into a category's shape each and registered to some of the clouds that
   single-cloud discovery would see (`registrar`), which are of as many objects as possible; the one stays that explains
   them best, and is registered to all. Clouds of a few whole objects say less: one that the collection turns over is a
   large part of it.
3. Where parts slide, one template says badly which part a point is of. There many objects are found from their clouds,
   their parts named alike (`named_alike`), and clouds of all of them, and copies in other proportions and joint states
   (`varied_clouds`), say for every cloud, by those most like it, which part its points are of (`similar_clouds`); the
   shape is then placed by that (`part_boxes`).

Descent on the whole category, which `discover` ends with, gives points to parts anew, and worse than an object's own
clouds do: it took the template's labels from an IoU of .68 to .43 on chests, from .94 to .93 on laptops.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.collection import Collection
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.named_alike import ObjectParts, named_alike
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS, find_one_object
from articulate_ssl.discovery.one_object.template import as_template
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.part_boxes import fit_part_boxes
from articulate_ssl.discovery.references import choose_objects, evenly_chosen
from articulate_ssl.discovery.registered_shape import RegisteredShape, trimmed_mean
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.discovery.varied_clouds import varied
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.progress import Stage, announce
from articulate_ssl.shape.observation import Observation

MOST_CLOUDS = 16  # of an object that are looked at: time goes with their square; more were not tried

# Objects are no templates of which more than this share of the points is unexplained, and this many times as many as
# of the best understood one: of washing machines .06 to .8 % where parts were right, 2.4 to 5 % where a door was turned
# by 10 degrees and more (docs/experiments.md, steps 71 and 84).
_UNDERSTOOD, _MOST_UNEXPLAINED = 0.01, 2.0

log = logging.getLogger(__name__)


class _Template(NamedTuple):
    """An object as a category's shape, and the share of its clouds' points that its parts do not explain.

    Attributes:
        parts: Its parts in its clouds, where all of the collection share a frame.
    """

    shape: RegisteredShape
    unexplained: float
    parts: ObjectParts | None


@flush_denormals()
def discover_grouped(
    clouds: Tensor,  # [n, N, 3] complete, in any orientation
    scans: Tensor,  # [m, N, 3] the same of whole objects, those of one object in one scale
    instance: Tensor,  # [m] which object each scan shows
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
) -> RegisteredShape:
    """Parts and joints of the category, registered to the clouds.

    Raises:
        DiscoveryError: if no object has scans enough, or the parts of none are found.
    """
    count, most_clouds = (options.objects, MIN_CLOUDS) if joint_type == PRISMATIC else (options.references, MOST_CLOUDS)
    objects = choose_objects(scans[:, : options.dense_points], instance, count, MIN_CLOUDS)
    if not len(objects):
        raise DiscoveryError(
            f"discovery.grouped needs an object with {MIN_CLOUDS} clouds or more among the {len(scans)} of discovery; "
            f"none has more than {int(instance.unique(return_counts=True)[1].max())}. Make more states of each object "
            '(`make data ... ARGS="--states 10"`), put all scans of an object into one folder (SOURCE=clouds), allow '
            "more --model.discovery.clouds, or leave grouped out"
        )
    of_object = [evenly_chosen((instance == one).nonzero().squeeze(-1), most_clouds) for one in objects]
    collection = Collection.of(torch.cat([clouds, scans[torch.cat(of_object)]]), joint_type, options, Observation())
    templates, last = [], len(clouds)
    for number, rows in enumerate(_announced(of_object), start=1):
        first, last = last, last + len(rows)
        frame = None if collection.frame is None else collection.frame[first:last]
        try:
            templates.append(_template(scans[rows], frame, options, num_parts, joint_type))
        except DiscoveryError as error:
            log.warning("part discovery leaves object %d of %d out: %s", number, len(objects), error)
            continue
        log.info("object %d: %.1f %% of its points unexplained", number, 100 * templates[-1].unexplained)
    if not templates:
        raise DiscoveryError(
            f"part discovery found the parts of none of {len(objects)} objects in the clouds of each: check number of "
            "parts and the type of joint, allow more --model.discovery.references, or leave grouped out"
        )
    given = slice(len(clouds))
    if collection.frame is None:
        candidates = [
            collection.registrar.register(template.shape, collection.few)
            for template in _understood(templates)[: options.references]
        ]
        best = min(candidates, key=lambda candidate: trimmed_mean(candidate.error, options))
        found = collection.registrar.register(best, collection.clouds).of_clouds(given)
    else:
        found = _placed(templates, clouds @ collection.frame[given].mT, options)
    _announce(len(objects) + 1, of_object, "done")
    return collection.as_given(found, given)


def _template(
    scans: Tensor,  # [m, N, 3] of one object
    frame: Tensor | None,  # [m, 3, 3] that turn them into the frame of the collection, if it has one
    options: DiscoveryOptions,
    num_parts: int,
    joint_type: int,
) -> _Template:
    """The object as a category's shape that stands as the collection does."""
    found = find_one_object(scans.cpu(), num_parts, joint_type, options.dense_points, options.seed)
    if not found.explained:
        raise DiscoveryError(
            f"{found.unexplained:.0%} of the points of its clouds lie off all its other clouds: not one object, or of "
            "different sizes"
        )
    shape, parts = as_template(found, options.dense_points, frame), None
    if frame is not None:
        # As most of its clouds stand; the others the collection has turned over.
        standing = scans[:, : found.label.shape[1]] @ (shape.base[:, :3, :3].mT @ frame).mT
        parts = ObjectParts(unit_boxes(standing)[0], found.label, found.shape.joints.chain.root)
    return _Template(shape, found.unexplained, parts)


def _understood(templates: list[_Template]) -> list[_Template]:
    """Those that are understood well, or about as well as the best."""
    most = max(_UNDERSTOOD, _MOST_UNEXPLAINED * min(template.unexplained for template in templates))
    return [template for template in templates if template.unexplained <= most]


def _placed(
    templates: list[_Template],
    clouds: Tensor,  # [n, N, 3] in the common frame
    options: DiscoveryOptions,
) -> RegisteredShape:
    """The template that fits best where its parts are placed by what similar clouds say that points are of."""
    templates = sorted(templates, key=lambda template: template.unexplained)
    num_parts, dense = templates[0].shape.shape.num_parts, clouds[:, : options.dense_points]
    objects = [template.parts for template in templates]
    names = named_alike(objects, num_parts)
    labels = torch.cat([name[one.label] for name, one in zip(names, objects, strict=True)])
    labelled = LabelledClouds(torch.cat([one.boxes for one in objects]), labels)
    by_first = labelled._replace(part=names[0].argsort()[labels])  # in the numbers that its joints know
    copies = varied(by_first, templates[0].shape.shape.joints, torch.Generator().manual_seed(options.seed))
    part = names[0][copies.votes(unit_boxes(clouds)[0], num_parts).argmax(dim=-1)]
    tried, candidates = _understood(templates)[: options.references], []
    for template, name in zip(tried, names, strict=False):
        own = name.argsort()  # its number for every common part
        fit = fit_part_boxes(template.shape.shape, dense, own[part][:, : options.dense_points])
        found = replace(RegisteredShape.of(fit, dense), point_part=own[part])
        candidates.append(replace(found, labelled=labelled._replace(part=own[labels])))
    return min(candidates, key=lambda candidate: trimmed_mean(candidate.error, options))


def _announced(objects: list[Tensor]) -> Iterator[Tensor]:
    """The scans of one object after the other, then the registration to all clouds."""
    for number, rows in enumerate(objects):
        _announce(number, objects, f"object {number + 1} of {len(objects)}")
        yield rows
    _announce(len(objects), objects, "registration to all clouds")


def _announce(done: int, objects: list[Tensor], name: str) -> None:
    announce(log, Stage("discovery from objects", name, done, len(objects) + 1))
