"""What is decided for takes the cloud's own proportions, and gives way where its joints are as none was seen.

Of an oven whose door is open wide, the door may be taken for that of the bottom: both explanations fit alike, but the
other door would be open farther than any. Joint limits are those of what is predicted of training clouds
(`state_range`); no label is read.
"""

from __future__ import annotations

from dataclasses import replace

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.candidates import Candidates
from articulate_ssl.inference.common_shape import CommonShape
from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.inference.other_hinge import OtherHinge
from articulate_ssl.inference.part_frames import FARTHEST, PartFrames
from articulate_ssl.inference.proportions import Descent, fit_proportions
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.chamfer import chamfer

# How much larger the error of what is within the joints' limits may be. Rivals of ovens that were explained by a door
# beyond them had up to 1.23 times the error (docs/experiments.md, step 144). Chosen.
ABOUT_AS_WELL = 1.3
_TURNED = 1.0  # degrees by which faces turn a part once more, from which on proportions are fitted once more


class FinalFit:
    """Fits explanations to clouds in the end.

    Args:
        articulated: The network, for the category's own shape.
        registration: Of hypotheses; says which joint states there are.
        part_frames: How the faces of parts lie.
        common_shape: What training clouds have in common.
        view_search: Simulated views, if there are any, know better than limits which way round objects are.
        object_frame: How views whose parts slide are turned, if that was learnt.
        cycles: Of descent; 0 leaves proportions out.
    """

    def __init__(
        self,
        articulated: ArticulatedNetwork,
        registration: HypothesisRegistration,
        part_frames: PartFrames,
        common_shape: CommonShape,
        view_search: ViewSearch,
        object_frame: ObjectFrame,
        cycles: int,
    ) -> None:
        self.articulated, self.registration = articulated, registration
        self.part_frames, self.common_shape = part_frames, common_shape
        self.view_search, self.object_frame, self.cycles = view_search, object_frame, cycles

    @property
    def fits(self) -> bool:
        """Whether explanations take proportions: where parts slide, only of views, and as these are turned."""
        return bool(self.cycles) and (self.articulated.joint_type == REVOLUTE or self.object_frame.learnt)

    def in_proportion(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
        hinge: OtherHinge | None = None,
    ) -> Hypotheses:  # H = 1
        """Explanations in the proportions of clouds (`fit_proportions`), turned as faces say.

        Which face is of which part, explanations say, so faces are asked before, and once more of what was fitted. Then
        joints may turn far, if the cloud is explained better.

        Args:
            hinge: Where all of them are hinged (`hinged_at`), if that is elsewhere than most are.
        """
        if not self.fits:
            return one
        category = self.articulated.category.articulated_shape(self.articulated.joint_type)
        observation, frames = self.registration.observation, self.part_frames
        if self.articulated.joint_type != REVOLUTE:
            if dense is None:
                return one
            one, turned = self.object_frame.settled(one, dense)
            known = turned, torch.zeros_like(one.state[:, 0], dtype=torch.bool)
            descent = Descent(self.cycles, observation.bidirectional, known=known, frame=self.object_frame.axes)
            return fit_proportions(one, category, points, descent)
        # Complete clouds, and scans that teach views, show where a hinge is.
        both = observation.bidirectional
        descent = Descent(self.cycles, both, touching=both and observation.orientation.limited)
        faces = dense is not None and frames.learnt
        if faces and self.common_shape.learnt:
            category = self.common_shape.shape(replace(category.joints, pivot=self.common_shape.pivot))
        if hinge is not None:
            frames, category = hinge.frames(frames, category.joints), hinge.shape(category)
        if not faces:
            return fit_proportions(one, category, points, descent)
        one, known = frames.settled(one, dense)
        descent = descent._replace(faces=frames.axes, known=known)
        if self.common_shape.learnt:
            pivot = category.joints.pivot.expand(len(points), -1, -1)
            one = replace(one, structure=replace(one.structure, pivot=pivot))
        fitted = fit_proportions(one, category, points, descent)
        # Registered with another shape, a part may be so far off that faces of others are taken for its own.
        settled, known = frames.settled(fitted, dense, afar=True)
        turn = _turn(settled, fitted)
        rows = (turn > _TURNED).nonzero()[:, 0]
        if not len(rows):
            return fitted
        again, known = one.at(settled.base, settled.state).rows(rows), (known[0][rows], known[1][rows])
        again = fit_proportions(again, category, points[rows], descent._replace(known=known))
        closer = self.distance(again, points[rows]) < self.distance(fitted.rows(rows), points[rows])
        kept = (closer | (turn[rows] < FARTHEST)).nonzero()[:, 0]
        return fitted.with_rows(rows[kept], again.rows(kept))

    def hinge(
        self,
        turn: Tensor,  # [3, 3] about the closed door's normal
        axes: Tensor,  # [3, 3] columns: of the object's box, hinge first, the door's normal last
    ) -> OtherHinge:
        """Where the category's hinge is turned to, in canonical space; it is known where the door is closed."""
        shape = self.articulated.category.articulated_shape(REVOLUTE)
        if self.common_shape.learnt:
            shape = self.common_shape.shape(replace(shape.joints, pivot=self.common_shape.pivot))
        return OtherHinge.of(shape, turn, axes, self.registration.states.rest.view(1))

    def hinged_at(self, one: Hypotheses, hinge: OtherHinge) -> Hypotheses:
        """The category's own shape as explanations are posed, but hinged elsewhere."""
        shape = hinge.shape(self.articulated.category.articulated_shape(REVOLUTE))
        return hinge.hypotheses(self.articulated.category_at(one.base, one.state), shape)

    def within_limits(
        self,
        one: Hypotheses,  # H = 1
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Explanations in the clouds' proportions; those whose joints are where none was seen give way to others.

        These are the same from other joint states, rivals, and what a search finds with the category's shape, if they
        are within what was seen and explain a cloud about as well. Nothing is sure then, so the margin is 0. Where
        simulated views said which way round objects are, it is only the former.
        """
        fitted = self.in_proportion(one, points, dense)
        out = (~self._within(fitted)).nonzero()[:, 0]
        if not (self.fits and len(out)):
            return fitted, rival, margin
        own, seen, before = points[out], None if dense is None else dense[out], one.rows(out)
        least = ABOUT_AS_WELL * self.distance(fitted, points)[out]
        others = () if self.view_search.learnt else ((rival.rows(out), False), (self._searched(own), False))
        for start, same in ((before, True), *others):
            tried = self.in_proportion(self.registration.freed(start, own), own, seen)
            error = self.distance(tried, own)
            better = (self._within(tried) & (error < least)).nonzero()[:, 0]
            least[better] = error[better]
            fitted = fitted.with_rows(out[better], tried.rows(better))
            if not same:
                rival = rival.with_rows(out[better], before.rows(better))
                margin = margin.index_fill(0, out[better], 0.0)
        return fitted, rival, margin

    def measure_closed(self) -> None:
        """Find out at which joint state the door is closed, unless that is known."""
        states = self.registration.states
        if not states.rests:
            shape = self.articulated.category.articulated_shape(self.articulated.joint_type)
            states.set_rest(closed_state(shape, states.known, self.part_frames))

    def distance(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B]
        """Of explanations from their clouds."""
        both = self.registration.observation.bidirectional
        return chamfer(points, one.posed()[:, 0].flatten(1, 2), bidirectional=both)

    def search(self, points: Tensor) -> Candidates:
        """Of clouds [B, N, 3] the registrations of the category's shape from everywhere (`search_articulated`).

        From the 60 rotations of the icosahedron, those within the orientation range, and from the joint states where
        `StateRange` starts; 3 for one joint.
        """
        rotations = rotation_group(60).elements.to(points)
        rotations = rotations[self.registration.observation.allows(rotations)]
        shape = self.articulated.category.articulated_shape(self.articulated.joint_type)
        starts = self.registration.states.starts().to(points)
        base, state, error = search_articulated(shape, points, rotations, starts)
        return Candidates(error, base, state, self.articulated.category_at(base, state).select)

    def _searched(self, points: Tensor) -> Hypotheses:
        """The best that is found within the joints' limits, H = 1."""
        found = self.search(points)
        allowed = self.registration.states.contains(found.state)
        turned = self.registration.observation.allows(found.base[..., :3, :3])
        return found.select(found.error.masked_fill(~(allowed & turned), torch.inf).argmin(dim=1))

    def _within(self, one: Hypotheses) -> Tensor:  # [B] bool
        return self.registration.states.contains(one.state[:, 0])


def _turn(one: Hypotheses, other: Hypotheses) -> Tensor:  # H = 1 each, [B] degrees
    """By how much the part that is turned most differently is."""
    turn = roma.rotmat_geodesic_distance(one.object_pose()[..., :3, :3], other.object_pose()[..., :3, :3])
    return turn[:, 0].amax(dim=-1).rad2deg()
