"""One object as a category's shape: what discovery registers to clouds of other objects."""

from __future__ import annotations

from dataclasses import replace

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.find import OneObject
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.slide_table import Direction
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.orientation_range import mean_rotation
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.stretch import principal_frame

# Degrees, chosen: all clouds of one object are turned alike in a common frame, to a degree or two, but for those that
# the frame has upside down or back to front, by 90 degrees or more.
_ALIKE = 20.0
_TILT = 10.0  # degrees, chosen: what slides farther than this from an axis of the common frame does not slide along it


def as_template(
    found: OneObject,
    num_points: int,
    frame: Tensor | None = None,  # [n, 3, 3] that turn the object's clouds into a frame all of the category's share
) -> RegisteredShape:
    """The object as a category's shape, registered to its clouds (in the common frame, if there is one).

    Points are spread evenly over the object instead of over each of its parts, in farthest-point order; state zero is
    the mean of the states.

    Raises:
        DiscoveryError: if there is a common frame and parts do not slide along an axis of it.
    """
    shape, base, state, axes = found.shape, found.base, found.state, None
    shape = replace(shape, joints=replace(shape.joints, limits=None))
    if frame is not None:
        frame = frame.to(base)
        base = se3(frame, frame.new_zeros(3)) @ base
        turn = _agreed(base[:, :3, :3])
        turn = se3(turn, turn.new_zeros(3))
        shape, base = shape.in_frame(turn), base @ invert_se3(turn)
        joints, state = _along_one_axis(shape.joints, state)
        shape, axes = replace(shape, joints=joints), torch.eye(3).expand(shape.num_parts, 3, 3)
    middle = state.mean(dim=0)
    shape = _thinned(resting_at(shape, middle), num_points)
    center = shape.points.mean(dim=0)
    place = principal_frame(shape.points) if frame is None else se3(torch.eye(3).to(center), -center)
    shape, base = shape.in_frame(place).with_centred_pivots(), base @ invert_se3(place)
    joints = replace(shape.joints, axis=shape.joints.axis.float(), pivot=shape.joints.pivot.float())
    shape = replace(shape, points=shape.points.float(), joints=joints)
    log_stretch, error = torch.zeros(len(state), shape.num_parts, 3), found.misfit.mean(dim=1)
    return RegisteredShape(shape, base.float(), (state - middle).float(), log_stretch, error.float(), axes)


def resting_at(
    shape: ArticulatedShape,
    state: Tensor,  # [J]
) -> ArticulatedShape:
    """The same shape, with these joint states called zero."""
    joints = shape.joints
    motion = joints.articulation(state)  # [K, 4, 4]
    carried = motion[list(joints.chain.parent)]
    axis = (carried[:, :3, :3] @ joints.axis[..., None]).squeeze(-1)
    pivot = transform_points(carried, joints.pivot[:, None])[:, 0]
    return replace(shape, points=shape.moved(motion[None])[0], joints=replace(joints, axis=axis, pivot=pivot))


def _thinned(shape: ArticulatedShape, num_points: int) -> ArticulatedShape:
    rows = torch.from_numpy(farthest_point_order(shape.points.numpy(), num_points))
    return replace(shape, points=shape.points[rows], label=shape.label[rows])


def _agreed(
    rotation: Tensor,  # [n, 3, 3]
) -> Tensor:  # [3, 3]
    """The mean of those rotations that most others are like."""
    alike = roma.rotmat_geodesic_distance(rotation[:, None], rotation).rad2deg() < _ALIKE
    return mean_rotation(rotation[alike[alike.sum(dim=1).argmax()]])


def _along_one_axis(
    joints: Joints,
    state: Tensor,  # [n, J]
) -> tuple[Joints, Tensor]:
    """All parts on the root, sliding one way along one coordinate axis, which is what offsets are read off for."""
    direction = Direction.of(joints.axis[0]).vector(joints.axis)
    tilt = float((joints.axis @ direction).abs().clamp(max=1).acos().rad2deg().max())
    if tilt > _TILT:
        raise DiscoveryError(f"its parts slide {tilt:.0f} degrees off the axes of the frame that all clouds share")
    chain = joints.chain
    slid = joints.articulation(state)[:, list(chain.child), :3, 3] @ direction
    star = KinematicChain(chain.num_parts, chain.root, (chain.root,) * len(chain.child), chain.child)
    return replace(joints, chain=star, axis=direction.expand(len(chain.child), 3).clone()), slid
