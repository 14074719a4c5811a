"""How `inference.box_turns` is taught for depth views: by simulated views of scans, with doors from closed to open.

No label is read. Discovery has found parts and hinges in scans of open doors, so it is known of their views how the
object is turned in front of the camera, whatever its door does. What lies in canonical space, being hinged at another
side than most, is shown as it stands. A view says how its box is turned up to quarters about the vertical, and one of
the four is right.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.inference.box_turns import VIEW_POINTS
from articulate_ssl.inference.hinge_sides import HingeSides
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.ops.progress import tell
from articulate_ssl.training.closed_door_lesson import nearly_closed
from articulate_ssl.training.explanations import with_noise
from articulate_ssl.training.scan_space import ScanSpace
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.surface_lessons import FEWEST, TAUGHT, learn_surface

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_CLOSED = 2 / 3  # of the views, with doors that are nearly closed. Chosen.
# Share of the views that did not teach it, of which the network must say how they are turned. Chosen.
_AGREES = 0.9

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_view_looks(
    module: ArticulatedPoseModule,
    data: SetClouds,
) -> None:
    """Teach a network which way round boxes look in views, with doors as far as closed."""
    estimator, states = module.estimator, module.states
    turns, camera = estimator.box_turns, estimator.hinge_sides.camera
    turns.surface = None  # of a run that ended and goes on
    turns.camera.forget()
    if not camera.learnt:  # no object lies, and nobody has asked where the door's normal points
        sides, camera = HingeSides().to(module.device), turns.camera
        shape = module.articulated.category.articulated_shape(module.articulated.joint_type)
        sides.measure(shape, states.known, estimator.part_frames)
        camera.learn(estimator.view_search.base[:, :3, :3], sides.axes)
    if not (camera.learnt and estimator.closed_views.learnt):
        tell(log, "how views look: it is not known which way is up, or how closed doors look")
        return
    estimator.other_views.measure()
    known = ScanSpace.of_scans(module, data, "how views look")
    if known is None:
        return
    scans, space = known
    random, each = np.random.default_rng(0), module.view_looks_samples / len(scans.clouds)
    shown, bases = [], []
    for limits, share in ((nearly_closed(states), _CLOSED), (states.known[0], 1 - _CLOSED)):
        try:
            views, found = space.views(scans, VIEW_POINTS, random, math.ceil(share * each), limits)
        except DiscoveryError:
            log.warning("how views look: no view shows %d points of the scans, take denser ones", VIEW_POINTS)
            return
        shown.append(views)
        bases.append(found.base)
    views, base = torch.cat(shown).to(module.device), torch.cat(bases).to(module.device)
    turns.axes.copy_(estimator.part_frames.axes[space.shape.joints.chain.root])
    frames, stands = _quarter_turned(base[:, :3, :3], camera, turns.axes)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(views), generator=generator).to(views.device)
    order = order[stands[order]]
    if TAUGHT * len(order) < FEWEST:
        tell(log, "how views look: too few of them, %d", len(order))
        return
    noisy = torch.cat([with_noise(some, generator) for some in views.split(_BATCH)])
    turns.surface = learn_surface((views, noisy), frames, order, _AGREES)


def _quarter_turned(
    rotation: Tensor,  # [n, 3, 3] canonical object space -> camera
    camera: UprightCamera,
    axes: Tensor,  # [3, 3]
) -> tuple[Tensor, Tensor]:  # [n, 4, 3, 3], [n]
    """Frames of objects as they stand, turned by quarters about the vertical, the right one first; and which stand."""
    stood, _, stands = camera.stood(rotation)
    up = axes.mT @ camera.up
    up = torch.zeros_like(up).index_fill(0, up.abs().argmax(), 1.0)
    quarters = roma.rotvec_to_rotmat(torch.arange(4).to(axes)[:, None] * (math.pi / 2) * up)
    return (stood @ axes)[:, None] @ quarters, stands
