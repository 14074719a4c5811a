"""Discovery for depth views from complete scans of some objects of the category, in the multi-state setting.

One view hides half of an object, and no single view is a good template. Where some objects were scanned from all sides,
in several states each, parts and joints are found there (`grouped`); the views of the category only say how objects are
turned in front of the camera (`view_orientations`). What teaches the network are views of the scans, simulated
(`simulated_views`), whose poses and states are known. No label is used; which scans show the same object is.

Canonical space lays hinges over each other, so that an object that is hinged at another side than most lies there.
Before views of it are simulated it is stood up: what teaches shows it as cameras do, and says that it lies. It is shown
in the mirror, too: who is hinged at one side may be at the other, which few scans show, or none.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.grouped import discover_grouped
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.simulated_views import simulate_views
from articulate_ssl.discovery.synchronization import standing_margins, unit_boxes
from articulate_ssl.discovery.upright_fit import lie
from articulate_ssl.discovery.view_orientations import find_view_orientations
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.progress import Stage, announce

_SIDES = 20  # from which every cloud is seen, to find how objects are turned in the views
_VIEWS = 30  # that are simulated of every scan, each of an object with other proportions and joint states

_UNKNOWN = -1  # quarters

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StandingScans:
    """Scans as they stand before the camera, of which views are simulated.

    Attributes:
        clouds: [m, P, 3] of objects, and of their mirror images.
        source: [m] which of the scans each is; -1 for what is in the mirror.
        found: The category's shape registered to them.
        turns: [m, V, 3, 3] canonical object space -> camera, of V views of each.
        mean_distance: Of a view's points to their centre.
    """

    clouds: Tensor
    source: Tensor
    found: RegisteredShape
    turns: Tensor
    mean_distance: float

    def views(
        self,
        num_points: int,
        generator: np.random.Generator,
        count: int | None = None,
        limits: Tensor | None = None,
    ) -> tuple[Tensor, RegisteredShape]:
        """`simulate_views` [k, num_points, 3], each of an object with other proportions and joint states.

        Args:
            count: Of each scan at most; None are all.
            limits: [J, 2] between which joint states are; None are those that scans show.
        """
        seen = self.clouds, self.turns[:, :count], num_points, self.mean_distance, generator
        return simulate_views(self.found, *seen, reshape=True, limits=limits)


@flush_denormals()
def discover_from_scans(
    views: Tensor,  # [v, P, 3] depth views of the category
    clouds: Tensor,  # [n, P, 3] complete, of as many objects as possible, in any orientation
    scans: Tensor,  # [m, P, 3] the same of whole objects
    instance: Tensor,  # [m] which object each scan shows
    num_parts: int,
    joint_type: int,
    options: DiscoveryOptions,
    orientation: OrientationRange,
    num_points: int,
    to_stand: Callable[[RegisteredShape, Tensor, Tensor], tuple[Tensor, Tensor]],
) -> tuple[Tensor, RegisteredShape, StandingScans]:
    """Simulated views [k, num_points, 3], parts and joints of the category registered to them; and of what they are.

    Args:
        orientation: How far objects are turned in the views.
        to_stand: Of a shape, the clouds it is registered to (scans, then their mirror images), and which of these [m]
            fit best: by how many quarters [n] objects are to be turned until they stand as most do, below zero where
            that is not known, and rotations [n, 3, 3] from canonical space as it then stands to canonical space.

    Raises:
        DiscoveryError: if parts are not found (`discover_grouped`).
    """
    found = discover_grouped(clouds, scans, instance, num_parts, joint_type, options)
    best = _likeliest(found, clouds)[: options.kept(len(clouds))]
    best = best[found.inside[best]]
    random, generator = np.random.default_rng(options.seed), torch.Generator().manual_seed(options.seed)
    mean_distance = float((views - views.mean(dim=1, keepdim=True)).norm(dim=-1).mean())
    quarters, source = torch.zeros(len(clouds), dtype=torch.long), torch.arange(len(clouds))
    if orientation.limited:
        count, clouds = len(clouds), torch.cat([clouds, _in_the_mirror(found, clouds)])
        source = torch.cat([source, torch.full_like(source, -1)])
        found = found.of_clouds(torch.arange(count).repeat(2))
        quarters, lying = to_stand(found, clouds, best)
        said = (quarters[:count] > 0).nonzero()[:, 0]
        believed = lie(found.of_clouds(said), clouds[said, : options.dense_points], lying[said])
        quarters[said[~believed]] = _UNKNOWN
        log.info("%d of %d scans that are said to lie fit upright, too", int((~believed).sum()), len(said))
        stands = quarters[:count] <= 0  # or it is not known: in the mirror it is no better known than in scans
        quarters[count:][stands] = quarters[:count][stands]
    best, lies = best[quarters[best] == 0], (quarters > 0).nonzero()[:, 0]
    kept = torch.cat([best, lies])
    turns = OrientationRange().draw(len(kept) * _VIEWS, generator)
    if orientation.limited:
        _announce(0, "how objects are turned")
        sides = turns[: len(best) * _SIDES].unflatten(0, (-1, _SIDES))
        seen, shown = simulate_views(found.of_clouds(best), clouds[best], sides, num_points, mean_distance, random)
        stand = find_view_orientations(views, seen, shown.base[:, :3, :3])
        found = found.turned(stand.mean)
        turns = stand.draw(len(turns), orientation, generator).unflatten(0, (-1, _VIEWS))
        turns = turns @ (stand.mean @ lying[kept].mT @ stand.mean.mT)[:, None]
    found, clouds = replace(found.of_clouds(kept), quarters=quarters[kept], sought=None), clouds[kept]
    _announce(1, "views of the scans")
    standing = StandingScans(clouds, source[kept], found, turns.reshape(len(kept), _VIEWS, 3, 3), mean_distance)
    simulated = standing.views(num_points, random)
    _announce(2, "done")
    return *simulated, standing


def _likeliest(found: RegisteredShape, clouds: Tensor) -> Tensor:  # [n]
    """Clouds [n, N, 3] in the order in which their poses are to be believed.

    A chest that is turned over fits about as well. Views of such clouds say of all others, too, that they are turned
    otherwise: with 12 % of them, how chests stand before a camera was found 99 degrees off, without any 12.
    """
    if found.axes is None:  # nothing stands in a common frame
        return found.error.argsort()
    boxes, _, _ = unit_boxes(clouds @ found.base[:, :3, :3] @ found.axes[0])
    return standing_margins(boxes, rotation_group(24)).argsort(descending=True)


def _in_the_mirror(
    found: RegisteredShape,  # registered to the clouds
    clouds: Tensor,  # [n, P, 3]
) -> Tensor:  # [n, P, 3]
    """Clouds of the mirror images of objects with one joint: along its axis, so that poses and states are the same."""
    axis = found.shape.joints.axis[0]
    along = found.shape.points @ axis
    middle = (along.min() + along.max()) / 2
    resting = transform_points(invert_se3(found.base), clouds)
    return transform_points(found.base, resting - 2 * (resting @ axis - middle)[..., None] * axis)


def _announce(done: int, name: str) -> None:
    announce(log, Stage("views from scans", name, done, 2))
