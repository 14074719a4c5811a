"""The category's shape with its door hinged at another side: the body stands as it does, the same door opens elsewhere.

An oven that is hinged at its side can be explained by one that lies on its side, hinged below. But nothing is where
that one has it, its shelves are walls and its height is its width; so what tells where the hinge is, the door, counts
for less than what does not. Here only the hinge moves: turned about the closed door's normal, from the edge of the door
that it is at to that which it is turned to.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple

import roma
from torch import Tensor

from articulate_ssl.geometry.screw import screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

_EDGE = 0.02  # share of a door's points beyond what is taken for its edge: strays are some. Chosen.


class OtherHinge(NamedTuple):
    """A hinge that is elsewhere than that of a category with one joint.

    Attributes:
        turn: [3, 3] about the closed door's normal, canonical space.
        closed: [1] joint state at which the door is closed, in either place.
        axis: [1, 3] unit, canonical space.
        pivot: [1, 3]
    """

    turn: Tensor
    closed: Tensor
    axis: Tensor
    pivot: Tensor

    @staticmethod
    def of(
        shape: ArticulatedShape,
        turn: Tensor,  # [3, 3]
        axes: Tensor,  # [3, 3] columns: of the object's box in canonical space, hinge first, the door's normal last
        closed: Tensor,  # [1]
    ) -> OtherHinge:
        """To where the hinge of a shape is turned: as far within the door's edge, and as far in front."""
        joints = shape.joints
        door, pivot = _closed_door(shape, closed), joints.pivot[0]
        across = axes[:, 1] * ((pivot - door.mean(dim=0)) @ axes[:, 1]).sign()
        axis, out, normal = turn @ joints.axis[0], turn @ across, axes[:, 2]
        within = _edge(door, across) - pivot @ across
        middle = (_edge(door, axis) - _edge(door, -axis)) / 2
        pivot = middle * axis + (_edge(door, out) - within) * out + (pivot @ normal) * normal
        return OtherHinge(turn, closed, axis[None], pivot[None])

    def shape(self, shape: ArticulatedShape) -> ArticulatedShape:
        """A shape, hinged there; its door is closed at the same joint state, and where it was."""
        joints = replace(shape.joints, axis=self.axis, pivot=self.pivot)
        back = invert_se3(screw_motion(*self[2:], self.closed, joints.joint_type)[0])
        points = shape.points.clone()
        points[shape.label == joints.chain.child[0]] = transform_points(back, _closed_door(shape, self.closed))
        return replace(shape, points=points, joints=joints)

    def frames(self, frames: PartFrames, joints: Joints) -> PartFrames:
        """How faces of parts lie in a shape so hinged, by the joints that it had."""
        moved, door = copy.deepcopy(frames), joints.chain.child[0]
        moved.direction[0] = self.turn @ frames.direction[0]
        closes = roma.rotvec_to_rotmat(self.closed * joints.axis[0])
        moved.axes[door] = roma.rotvec_to_rotmat(-self.closed * self.axis[0]) @ closes @ frames.axes[door]
        return moved

    def hypotheses(
        self,
        one: Hypotheses,
        shape: ArticulatedShape,  # as many points of every part
    ) -> Hypotheses:
        """A shape so hinged (`shape`), posed as explanations are."""
        parts = shape.points.unflatten(0, (shape.num_parts, -1))
        middle, (clouds, copies) = parts.mean(dim=1), one.base.shape[:2]
        own = CanonicalShape((parts - middle[:, None]).expand(clouds, -1, -1, -1), middle.expand(clouds, -1, -1))
        axis, pivot = self.axis.expand(clouds, copies, 1, 3), self.pivot.expand(clouds, 1, 3)
        lines = replace(one.structure, pair_axis=axis, axis=axis, pair_pivot=pivot, pivot=pivot)
        return replace(one, shape=own, structure=lines)


def _closed_door(shape: ArticulatedShape, closed: Tensor) -> Tensor:  # [m, 3]
    joints = shape.joints
    return transform_points(
        screw_motion(joints.axis, joints.pivot, closed, joints.joint_type)[0], shape.part(joints.chain.child[0])
    )


def _edge(points: Tensor, direction: Tensor) -> Tensor:
    """How far points [m, 3] reach in a direction [3]."""
    return (points @ direction).quantile(1 - _EDGE)
