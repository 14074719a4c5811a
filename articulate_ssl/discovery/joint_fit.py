"""From free bodies to an articulated shape: a tree of one-degree-of-freedom joints that explains how parts move."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.bodies import Bodies
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.discovery.screw_fit import fit_screw
from articulate_ssl.geometry.kinematic_chain import KinematicChain, extract_chain, pair_index
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.stretch import principal_frame

_SCALES, _ROUNDS = (0.03, 0.02), 8  # of the registration that ends on the joints


class _Assembly(NamedTuple):
    """Parts at joint states zero in the root's frame, their joints, and the states [n, J] of the clouds."""

    points: Tensor
    joints: Joints
    state: Tensor


def fit_joints(
    bodies: Bodies,
    clouds: Tensor,  # [n, N, 3]
    joint_type: int,
    turned: bool = True,
) -> RegisteredShape:
    """Reduce free part poses to a tree of joints.

    Args:
        turned: Canonical object space has the shape's principal axes; if not, it has the template's, and only its
            centre is the shape's.
    """
    chain = likeliest_chain(bodies, joint_type)
    points, joints, state = _assemble(bodies, chain, joint_type)
    shape = ArticulatedShape(points, bodies.shape.label, joints)
    frame = principal_frame(points) if turned else se3(torch.eye(3).to(points), -points.mean(dim=0))
    shape = shape.in_frame(frame).with_centred_pivots()
    base = bodies.pose[:, chain.root] @ invert_se3(frame)
    few = shape.thinned(clouds.shape[1])
    base, state, error = register_articulated(few, clouds, base, state, _SCALES, _ROUNDS)
    return RegisteredShape(shape, base, state, points.new_zeros(len(clouds), shape.num_parts, 3), error)


def likeliest_chain(bodies: Bodies, joint_type: int) -> KinematicChain:
    """The spanning tree over the pairs of parts whose relative motion is most like a joint's."""
    shape, pose, gaps = bodies.shape, bodies.pose, []
    for i, j in pair_index(shape.num_parts).tolist():
        relative = invert_se3(pose[:, i]) @ pose[:, j]
        # What fits must fit from either side.
        gap = fit_screw(relative, shape.part(j), joint_type).gap
        inverse = fit_screw(invert_se3(relative), shape.part(i), joint_type).gap
        gaps.append(gap.median() + inverse.median())
    return extract_chain(-torch.stack(gaps), shape.num_parts)


def _assemble(bodies: Bodies, chain: KinematicChain, joint_type: int) -> _Assembly:
    shape, pose = bodies.shape, bodies.pose
    into_object = {chain.root: torch.eye(4).to(pose)}
    axes, pivots, states = [], [], []
    for parent, child in zip(chain.parent, chain.child, strict=True):
        relative = invert_se3(pose[:, parent]) @ pose[:, child]
        axis, pivot, state, mean, _ = fit_screw(relative, shape.part(child), joint_type)
        frame = into_object[parent]
        into_object[child] = frame @ mean
        axis = frame[:3, :3] @ axis
        if axes and axis @ axes[0] < 0:  # all joints of an object point one way, as far as they are parallel
            axis, state = -axis, -state
        axes.append(axis)
        pivots.append(transform_points(frame, pivot[None])[0])
        states.append(state)
    points = shape.points.clone()
    for part in range(shape.num_parts):
        mine = shape.label == part
        points[mine] = transform_points(into_object[part], points[mine])
    joints = replace(shape.joints, chain=chain, axis=torch.stack(axes), pivot=torch.stack(pivots))
    return _Assembly(points, replace(joints, joint_type=joint_type), torch.stack(states, dim=1))
