"""Registered clouds with other proportions and joint states: objects that nobody scanned, without a label.

Where a shape is registered to a cloud, every point of the cloud has a part, and so a place in canonical object space,
at rest. There the whole object is made longer or shorter along its own axes, then articulated anew. Points go on
showing what was scanned: no template and no mesh takes their place.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.se3 import invert_se3
from articulate_ssl.ops.chamfer import nearest_index
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.object_axes import object_axes
from articulate_ssl.shape.part_maps import PartMaps

_SPREAD = 0.2  # largest logarithm of a proportion. Chosen, not tuned.


class Reshaped(NamedTuple):
    """Clouds of other objects, and the joint states they are in; base poses stay."""

    points: Tensor  # [n, P, 3]
    normals: Tensor  # [n, P, 3] unit, of either sign
    state: Tensor  # [n, J]


class Reshaping:
    """What draws such clouds.

    Args:
        found: A shape registered to the clouds.
        clouds: [n, P, 3].

    Attributes:
        point_part: [n, P] `point_parts`.
    """

    def __init__(self, found: RegisteredShape, clouds: Tensor) -> None:
        self._found, self._points, self._joints = found, clouds, instance_joints(found)
        self.point_part = point_parts(found, clouds)
        self._axes = object_axes(found.shape)
        normals = [Surface.of(cloud).normals for cloud in clouds.double().numpy()]
        self._normals = torch.from_numpy(np.stack(normals)).to(clouds)

    def unchanged(self) -> Reshaped:
        """The clouds as they are."""
        return Reshaped(self._points, self._normals, self._found.state)

    def draw(
        self,
        generator: torch.Generator,
        limits: Tensor | None = None,  # [J, 2]
    ) -> Reshaped:
        """Proportions and joint states of every cloud anew, states evenly within limits, or what the clouds show."""
        state = self._found.state
        log_scale = _SPREAD * (2 * torch.rand(len(state), 3, generator=generator) - 1)
        log_scale = log_scale - log_scale.mean(dim=1, keepdim=True)  # as large as before
        low, high = (self._found.limits() if limits is None else limits).to(state).unbind(-1)
        return self.at(log_scale.to(state), low + (high - low) * torch.rand(state.shape, generator=generator).to(state))

    def at(
        self,
        log_scale: Tensor,  # [n, 3] along the object's axes
        state: Tensor,  # [n, J]
    ) -> Reshaped:
        """Of given proportions and states."""
        scale = (self._axes * log_scale.exp()[:, None]) @ self._axes.mT  # [n, 3, 3], about the canonical origin
        joints, base = self._joints, self._found.base
        reshaped = replace(
            joints,
            axis=functional.normalize(joints.axis @ scale, dim=-1),
            pivot=joints.pivot @ scale,
        )
        rest = PartMaps.of(invert_se3(joints.part_pose(base, self._found.state)))
        stretched = PartMaps(scale[:, None] @ rest.linear, rest.shift @ scale)
        maps = stretched.then(reshaped.part_pose(base, state))
        normals = torch.einsum(
            "npij,npj->npi", _by_point(torch.linalg.inv(maps.linear).mT, self.point_part), self._normals
        )
        points = torch.einsum("npij,npj->npi", _by_point(maps.linear, self.point_part), self._points)
        points = points + _by_point(maps.shift, self.point_part)
        return Reshaped(points, functional.normalize(normals, dim=-1), state)


def point_parts(found: RegisteredShape, clouds: Tensor) -> Tensor:  # [n, P]
    """Which part points are of: what the registration says, else the nearest of the shape's, as it is there."""
    if found.point_part is not None:
        return found.point_part
    return found.shape.label[nearest_index(clouds, _fit(found).posed())]


def instance_joints(found: RegisteredShape) -> Joints:
    """Joints in canonical object space, [n, J, 3] each, in the proportions of the clouds."""
    joints = _fit(found).instances().joints
    return replace(joints, axis=joints.axis.expand_as(joints.pivot))


def _fit(found: RegisteredShape) -> InstanceFit:
    own = found.axes, found.log_stretch, found.beside
    return InstanceFit(found.shape, found.base, found.state, torch.Generator(), *own)


def _by_point(of_part: Tensor, label: Tensor) -> Tensor:
    """[n, K, ...] of parts -> [n, P, ...] of points."""
    return of_part[torch.arange(len(label), device=label.device)[:, None], label]
