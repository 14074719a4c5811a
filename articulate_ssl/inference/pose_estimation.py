"""From clouds to articulated poses: aligned, hypothesised over the group, iterated, chosen, and registered.

1. *Alignment* (stage 0), and
2. *iteration*, to a hypothesis per group element: `proposals`.
3. *Registration* at test time: the leading hypotheses' predicted shapes are registered to the cloud without leaving
   their joints, and the best reconstruction wins. What is decided for in the end takes the cloud's own proportions
   (`proportions`), turned as its parts' faces say (`part_frames`), with the shape that clouds of the collection have
   in common (`common_shape`), after which faces are looked at again; and if its joints are then beyond their limits,
   it gives way to what is within them (`final_fit`). Boxes with doors are sought square to their faces, too, with
   doors as far as closed, and hinged at other sides, if some are (`square_search`, `other_hinge`).
   Where parts slide, clouds of other objects that are most like it decide which way round it is; where these are
   labelled, they say which parts points are of, and where the category's shape is (`sliding_search`).
   Where simulated views taught, those that a view is most like decide which way round it is, and say with the
   posed shape which parts points are of (`view_search`); what slides is in the end where these points are
   (`front_ends`), and where some objects are hinged elsewhere, either kind is tried, and so are doors that are nearly
   closed (`other_views`).
4. *Decision* between two explanations of a cloud, where that was learnt (`decision`): the winner and its twin, which is
   registered, too, if the winner was, or the winner and its rival.
5. *Side*, where some doors are hinged at another side than most: frames are turned so that what is seen looks right
   (`hinge_sides`), and what stood wrongly is explained anew.
6. *Hand*, where upright cameras see objects and their mirror images: clouds are explained in a mirror, too, and how
   well either explains them decides (`handedness`).
7. *Poses* of a prediction that is not registered, and which parts points are of, a network says that fits taught, in
   the frame of that prediction (`pose_network`).
8. *Hinges* of boxes with doors: where the closed door lies on its body (`closed_contact`).

Training takes the first two steps too; nothing here knows a loss or an optimiser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.registration import chamfer_l1
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.box_turns import BoxTurns
from articulate_ssl.inference.candidates import (
    ANOTHER_WAY,
    Candidates,
    angle_to,
    better,
    rivals,
)
from articulate_ssl.inference.closed_contact import ClosedPlates, resting_on_bodies
from articulate_ssl.inference.common_shape import CommonShape
from articulate_ssl.inference.decision import BothWays, Decision
from articulate_ssl.inference.final_fit import ABOUT_AS_WELL, FinalFit
from articulate_ssl.inference.front_ends import FrontEnds
from articulate_ssl.inference.handedness import Handedness, both_hands
from articulate_ssl.inference.hinge_sides import HingeSides
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.other_views import OtherViews
from articulate_ssl.inference.packaging import as_prediction
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.pose_network import PoseNetwork
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.proposals import Proposals
from articulate_ssl.inference.relief import NUM_FEATURES
from articulate_ssl.inference.sliding_search import SlidingSearch
from articulate_ssl.inference.square_search import SquareSearch
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.inference.two_ways import TwoWays
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.shape.observation import Observation

# Of the width of a joint's range: registration, before proportions, leaves doors 10 degrees off and more. Chosen.
_WELL_BEYOND = 0.15
_RARE = 1.1  # by which errors of what is hinged elsewhere than most count more (docs/experiments.md, step 153). Chosen.


class _How(NamedTuple):
    """How a prediction is made.

    Attributes:
        num_points: The networks read this many leading points; None: the network of the paper is left out (`search`).
        registers: What is proposed is registered.
        fits: It takes the clouds' proportions, or poses as a network says.
        rivals: They are told, too.
    """

    num_points: int | None
    registers: bool
    fits: bool = True
    rivals: bool = False


class _Chosen(NamedTuple):
    """What is decided for, before it takes clouds' proportions.

    Attributes:
        one: H = 1.
        rival: H = 1, the best that is turned another way.
        margin: [B] between them (`Prediction.margin`).
        votes: Which parts of points other clouds or views say, if there are any.
        said: [B, 3, 3] see `Candidates.said`.
    """

    one: Hypotheses
    rival: Hypotheses
    margin: Tensor
    votes: Votes | None = None
    said: Tensor | None = None


class PoseEstimator(Proposals):
    """Pose estimation with the networks of a module, which owns them, trains them and saves them.

    Args:
        articulated: The articulated network.
        rigid: Stage 0's network, or None where clouds are taken as they come.
        iterations: Pose estimations per cloud.
        observation: How clouds are taken.
        posterior_scale: Standard deviation of the association of points with posed parts, in normalised units.
        inference: Registration at test time.

    Attributes:
        two_ways: The decision between explanations that fit alike, if one was learnt; a module owns it.
        sliding: The search for parts that slide, if one was learnt; a module owns it.
        view_search: The search among simulated views, if there were any; a module owns it.
        handedness: Whether clouds show the category's mirror image, if some do; a module owns it.
        hinge_sides: At which side objects are hinged, if not all at the same; a module owns it.
        part_frames: How the faces of parts lie; a module owns it.
        common_shape: What training clouds have in common, if it was learnt; a module owns it.
        object_frame: How views of what slides are turned, if it was learnt; a module owns it.
        front_ends: Which ends of what slides views show, if it was learnt; a module owns it.
        states: Which joint states training clouds showed; a module owns it.
        pose_network: Which poses fits would say, if that was taught; a module owns it.
        box_turns: Which way round boxes with doors look right, if that was taught; a module owns it.
        closed_views: Simulated views of doors that are nearly closed, if there were any; a module owns it.
        closed_plates: Where hinges of plates are, if that was learnt; a module owns it.
    """

    def __init__(
        self,
        articulated: ArticulatedNetwork,
        rigid: RigidAlignment | None,
        iterations: int,
        observation: Observation,
        posterior_scale: float,
        inference: InferenceOptions,
    ) -> None:
        self.posterior_scale, self.inference = posterior_scale, inference
        self.two_ways = TwoWays(articulated.num_parts, articulated.num_parts * NUM_FEATURES)
        self.sliding = SlidingSearch(*articulated.category.template.shape[:2], observation.bidirectional)
        self.view_search = ViewSearch(articulated.num_parts)
        self.handedness = Handedness()
        self.hinge_sides = HingeSides(observation.bidirectional)
        self.states = StateRange(articulated.num_parts - 1)
        self.part_frames = PartFrames(articulated.num_parts)
        self.common_shape = CommonShape(articulated.num_parts)
        self.object_frame = ObjectFrame()
        self.front_ends = FrontEnds(articulated.num_parts - 1)
        self.pose_network = PoseNetwork(articulated.num_parts)
        self.box_turns = BoxTurns()
        self.closed_views = ViewSearch(articulated.num_parts)
        self.closed_plates = ClosedPlates()
        super().__init__(articulated, rigid, iterations, replace(observation, camera=self.hinge_sides.camera))
        self.registration = HypothesisRegistration(inference, self.observation, self.states)
        self.decision = Decision(articulated, self.registration, self.two_ways)
        self.final = FinalFit(
            articulated,
            self.registration,
            self.part_frames,
            self.common_shape,
            self.view_search,
            self.object_frame,
            inference.proportions,
        )
        self.other_views = OtherViews(self.final, self.hinge_sides.camera, self.closed_views, self.box_turns)
        self.square_search = SquareSearch(self.final, self.hinge_sides, self.box_turns)

    def _registers(self, refine: bool | None) -> bool:
        """What the options say, unless it is said."""
        return (self.inference.refine if refine is None else refine) is not False

    @property
    def reads_dense(self) -> bool:
        """Whether what is decided or measured in the end reads all points of a cloud."""
        decides = self.two_ways.learnt or self.two_ways.surface is not None or self.hinge_sides.learnt
        measures = self.part_frames.learnt or self.object_frame.learnt or self.pose_network.learnt
        return bool(decides or measures)

    @torch.no_grad()
    def predict(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        refine: bool | None = None,
        dense: Tensor | None = None,  # [B, P, 3] the same clouds with all their points
    ) -> Prediction:
        """Predictions for whole clouds; one cloud's does not depend on the rest of the batch.

        Args:
            num_points: The networks read this many leading points; registration reads all.
            refine: Register at test time, or not; None does what the options say.
            dense: What a decision between two explanations and a search for sliding parts read, an even sample of the
                surface and about as many points as in training; without them there is neither, and without
                registration no search. All are labelled, too.

        Raises:
            ValueError: if a cloud has NaN or infinite points.
        """
        return self._predicted(points, dense, _How(num_points, self._registers(refine)))[0]

    @torch.no_grad()
    def predict_with_rivals(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        refine: bool | None = None,
        dense: Tensor | None = None,  # [B, P, 3]
        fits: bool = True,
    ) -> tuple[Prediction, Prediction]:
        """`predict`, and of every cloud the best hypothesis that is turned another way (the same, if none is).

        Args:
            fits: Predictions take the clouds' proportions, or poses as a network says; rivals do not.

        Raises:
            ValueError: if a cloud has NaN or infinite points.
        """
        return self._predicted(points, dense, _How(num_points, self._registers(refine), fits, rivals=True))

    @torch.no_grad()
    def search(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        dense: Tensor | None = None,  # [B, P, 3] the same clouds with all their points
    ) -> Prediction:
        """`predict`, registered, without the network of the paper: what that is worth.

        Where it would propose hypotheses, the category's shape and joints are searched from everywhere
        (`FinalFit.search`); where other clouds or views say where it is, nothing competes with them. All that is learnt
        after training has its say.

        Raises:
            ValueError: if a cloud has NaN or infinite points.
        """
        return self._predicted(points, dense, _How(None, registers=True))[0]

    def _predicted(self, points: Tensor, dense: Tensor | None, how: _How) -> tuple[Prediction, Prediction]:
        """See `predict_with_rivals` and `search`; without `rivals` the second prediction is of no use."""
        if not torch.isfinite(points).all():
            raise ValueError("a cloud has NaN or infinite points")
        found, rival = self._decided(points, dense, how)
        if not how.fits or dense is None:
            return found, rival
        with torch.autocast(points.device.type, enabled=False):
            # Similar views say parts, too, better than posed shapes; whether better than this network was not asked.
            if self.pose_network.learnt and not (how.registers and self.view_search.learnt):
                says = self.pose_network.labelled if how.registers else self.pose_network.posed
                found = says(found, points, dense)
            if how.registers and self.closes:
                rest = self.states.rest - self.hinge_sides.closed * self.hinge_sides.learnt
                found = resting_on_bodies(found, dense, *self.closed_plates.closing(rest))
        return found, rival

    @property
    def closes(self) -> bool:
        """Whether doors are closed to see where their hinges are: it is known how, and clouds show all sides."""
        known = bool(self.states.rests or self.closed_plates.learnt) and self.articulated.num_parts == 2
        return self.inference.closed_contact and known and not self.observation.orientation.limited

    def _decided(self, points: Tensor, dense: Tensor | None, how: _How) -> tuple[Prediction, Prediction]:
        """See `_predicted`: before a network says poses."""
        count, hands = len(points), self.handedness.hands
        shown = None if dense is None else hands(dense)
        *every, error = self._explained(hands(points), shown, how)
        seen = [one[:count] for one in every]
        if self.hinge_sides.learnt:
            seen = [self.hinge_sides.counted_from_closed(one) for one in seen]
            seen[0], quarters = self.hinge_sides.decided(seen[0], dense)
            if how.fits and how.registers and not self.other_views.lie:
                seen[0] = self._as_most_are(seen[0], quarters, points, dense)
        if not self.handedness.learnt:
            return tuple(seen)
        mirrored = [one[count:] for one in every]
        return self.handedness.likelier(seen, mirrored, self.handedness.log_odds(error[:count], error[count:]))

    @torch.no_grad()
    def mirror_errors(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
    ) -> tuple[Tensor, Tensor]:  # [B], [B]
        """Errors of predictions, and of those of the clouds' mirror images, from which `handedness` learns."""
        how = _How(num_points, self._registers(None), fits=False)
        return self._explained(both_hands(points), None, how)[2].chunk(2)

    def _explained(self, points: Tensor, dense: Tensor | None, how: _How) -> tuple[Prediction, Prediction, Tensor]:
        """See `_predicted`: by the category's own hand; and errors [B], by which hands are told apart.

        These are the errors before proportions, as proportions make up for the wrong hand; but of doors that may be
        closed those by which ways are told apart, as the explanation before is one of open doors.
        """
        with torch.autocast(points.device.type, enabled=False):
            self.square_search.measure()
            self.other_views.measure()
            chosen, other, margin, votes, said = self._chosen(points, how.num_points, how.registers, dense)
            before = None
            if how.registers and how.fits:
                before = self.final.distance(chosen, points)
                chosen, other, margin = self.final.within_limits(chosen, other, margin, points, dense)
                chosen, other, margin = self.square_search.sought(chosen, other, margin, points, dense, said)
                sought = self.other_views.sought(chosen, other, margin, votes, points, dense)
                chosen, other, margin, votes, error = sought
                before = error if self.other_views.every_way else before
                if self.view_search.parts is not None and self.object_frame.learnt and dense is not None:
                    turn = (chosen.base[:, 0, :3, :3] @ self.object_frame.axes).mT
                    votes = self.view_search.parts.beside(votes, dense, turn)
            found = self._packaged(chosen, points, margin, votes, dense)
            rival = self._packaged(other, points, torch.zeros_like(margin)) if how.rivals else found
            square = self.object_frame.learnt and self.front_ends.learnt
            if how.registers and how.fits and square and dense is not None:
                category = self.articulated.category.articulated_shape(self.articulated.joint_type)
                chosen = self.front_ends.placed(chosen, self.object_frame, category, dense, found.dense_part_id)
                found = self._packaged(chosen, points, margin, votes, dense)
            return found, rival, found.reconstruction_error if before is None else before

    def _as_most_are(
        self,
        turned: Prediction,  # joint states count from the closed door
        quarters: Tensor,  # [B] by which frames were turned
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> Prediction:
        """Predictions whose frames were turned, or, if that fits better, objects in these frames hinged as most are.

        Either an object is hinged at another side, or it stood wrongly and its hinge was sought on the wrong one.
        """
        rows = quarters.nonzero()[:, 0]
        if not len(rows):
            return turned
        own, seen, middle = points[rows], None if dense is None else dense[rows], self.states.starts()[:1].to(points)
        base = turned.base_pose[rows, None]
        start = self.articulated.category_at(base, middle.expand(len(rows), 1, -1))
        tried = self.final.in_proportion(self.registration.freed(start, own), own, seen)
        packaged = self._packaged(tried, own, turned.margin[rows], dense=seen)
        packaged = self.hinge_sides.counted_from_closed(packaged)
        as_turned = angle_to(tried.base[..., :3, :3], base[:, 0, :3, :3])[:, 0] < ANOTHER_WAY
        fits = packaged.reconstruction_error < turned.reconstruction_error[rows]
        better = (as_turned & fits & self.states.contains(tried.state[:, 0])).nonzero()[:, 0]
        return turned.with_rows(rows[better], packaged[better])

    @torch.no_grad()
    def explained(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        dense: Tensor,  # [B, P, 3] the same clouds with all their points
    ) -> Hypotheses:  # H = 1
        """What is decided for, registered, before it takes clouds' proportions: from which `part_frames` learn."""
        with torch.autocast(points.device.type, enabled=False):
            return self._chosen(points, num_points, True, dense).one

    def _chosen(self, points: Tensor, num_points: int | None, registers: bool, dense: Tensor | None) -> _Chosen:
        """See `_Chosen`."""
        if registers and self.view_search.learnt:
            chosen = self._seen(points, dense, num_points)
        elif registers and dense is not None and self.sliding.learnt:
            chosen = self._slid(points, dense, num_points)
        else:
            candidates = self._candidates(points, num_points, registers)
            chosen = _Chosen(*self._best(candidates), said=candidates.said)
        one, rival, margin = chosen[:3]
        if dense is not None and self.two_ways.learnt:
            one, rival, margin = self.decision.by_relief(one, points, dense, registers)
        elif dense is not None and self.two_ways.surface is not None:
            one, rival, margin = self.decision.by_surface(one, rival, margin, points, dense, registers)
        return chosen._replace(one=one, rival=rival, margin=margin)

    def _best(self, candidates: Candidates) -> tuple[Hypotheses, Hypotheses, Tensor]:
        """The best candidate of every cloud, its rival, and the margin between them [B].

        Errors of those whose joints are well beyond their limits count more, by as much as `FinalFit` lets them; and a
        little more, where it is known which way is up, those of what lies on its side, as few are hinged elsewhere.
        """
        rotation, likely = candidates.base[..., :3, :3], self.states.contains(candidates.state, _WELL_BEYOND)
        error = torch.where(likely, candidates.error, ABOUT_AS_WELL * candidates.error)
        camera = self.hinge_sides.camera
        if camera.learnt:
            error = torch.where(camera.stood(rotation)[1] > 0, _RARE * error, error)
        best = self.observation.ranked(error, rotation).argmin(dim=1)
        allowed = self.observation.allows(rotation)
        rival, margin = rivals(error, candidates.base, best, allowed)
        return candidates.select(best), candidates.select(rival), margin

    @torch.no_grad()
    def both_ways(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        dense: Sequence[Tensor],  # of [B, P, 3] the same clouds with all their points
    ) -> BothWays:
        """From which `two_ways` learns to decide: see `Decision.both_ways`, of predictions."""
        chosen, _, _ = self._best(self._candidates(points, num_points, registers=True))
        return self.decision.both_ways(chosen, points, dense)

    def _candidates(
        self,
        points: Tensor,  # [B, N, 3]
        num_points: int | None,
        registers: bool,
        turn: Tensor | None = None,  # [B, 3, 3] canonical object space -> camera
    ) -> Candidates:
        """The network's hypotheses, or the leading ones registered, or what is searched, in the frame of the points.

        Args:
            turn: Of those, hypotheses that are not turned about so are registered only where too few are.
        """
        if num_points is None:
            return self.final.search(points)
        if registers:
            aligned, pose = self.align(points[:, :num_points])
            *_, last = self.iterate(aligned)
            turn = None if turn is None else pose[:, :3, :3].mT @ turn
            candidates, error = self.registration.leading(last, transform_points(invert_se3(pose), points), turn)
            said = (pose @ last.hypotheses.select(last.winner).base[:, 0])[:, :3, :3]
        else:
            candidates, error, pose = self.proposed(points[:, :num_points])
            said = None
        candidates = candidates.at(pose[:, None] @ candidates.base, candidates.state)
        return Candidates(error, candidates.base, candidates.state, candidates.select, said)

    def _slid(
        self,
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3]
        num_points: int | None,
    ) -> _Chosen:
        """The category's shape where the search for sliding parts finds it, and its rival.

        Which way round clouds are, the search decides; with `num_points` the network's hypotheses that are turned alike
        compete by their errors. Which parts points are of, labelled clouds vote, if there are any.
        """
        shape, base, state, margin, votes = self.sliding.search(self.articulated.category.chain(), dense)
        clouds, count = base.shape[:2]
        rows, parts = torch.arange(clouds, device=points.device), shape.points.unflatten(1, (shape.num_parts, -1))

        def select(index: Tensor) -> Hypotheses:
            own = rows * count + index
            center = parts[own].mean(dim=2)
            found = self.articulated.category_at(base[rows, index, None], state[rows, index, None])
            axis = shape.joints.axis.expand(clouds, 1, -1, -1)
            structure = replace(found.structure, pivot=shape.joints.pivot[own], axis=axis)
            return replace(found, shape=CanonicalShape(parts[own] - center[:, :, None], center), structure=structure)

        first, rival = select(torch.zeros_like(rows)), select(torch.ones_like(rows))
        if num_points is None:
            return _Chosen(first, rival, margin, votes)
        error = chamfer_l1(points, first.posed()[:, 0].flatten(1, 2), self.observation.bidirectional)
        others = self._candidates(points, num_points, registers=True)
        return _Chosen(better(first, error, others, first.base[:, 0, :3, :3]), rival, margin, votes)

    def _seen(
        self,
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
        num_points: int | None,
    ) -> _Chosen:
        """The category's shape, registered from where the search among simulated views finds it, and its rival.

        Which way round objects are, the search decides, or a network, if that was taught; with `num_points` the
        articulated network's hypotheses that are turned alike compete by their errors. Which parts points are of, the
        views vote.
        """
        seen = self.view_search.search(points)
        if dense is not None and self.object_frame.surface is not None:
            turn, margin, other = self.object_frame.looked_at(dense, seen.base[:, 0, :3, :3])
            seen, rows = seen._replace(margin=margin), other.nonzero()[:, 0]
            if len(rows):
                again = self.view_search.search(points[rows], turn[rows])
                seen = seen.with_rows(rows, again._replace(margin=margin[rows]))
        base, state, margin, votes = seen
        likelier, rival = (self.articulated.category_at(base[:, i, None], state[:, i, None]) for i in range(2))
        first, error = self.registration.registered(likelier, points)
        if num_points is None:
            return _Chosen(first, rival, margin, votes)
        turn = base[:, 0, :3, :3]
        chosen = better(first, error[:, 0], self._candidates(points, num_points, True, turn), turn)
        return _Chosen(chosen, rival, margin, votes)

    def _packaged(
        self,
        chosen: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        margin: Tensor,  # [B]
        votes: Votes | None = None,
        dense: Tensor | None = None,  # [B, P, 3]
    ) -> Prediction:
        """See `as_prediction`."""
        neighbours = self.inference.part_neighbours or 1
        distance = self.final.distance(chosen, points)
        return as_prediction(chosen, points, distance, margin, self.posterior_scale, neighbours, votes, dense)
