"""Explanations of depth views by what few views show, or none: objects hinged at another side, and closed doors.

A view of an object that is hinged elsewhere than most (`hinge_sides`) is often more like one of the many others. Once
either explanation has the cloud's proportions, errors tell better: of 40 views of ovens that are hinged at the side 35
are right then (docs/experiments.md, step 246). So both are always sought, where simulated views and a camera know both.

Training shows doors that are open, and users scan closed ones, which no view was like: another side of a box was taken
for an open door. But scans show whole objects, and a door whose hinge is known can be closed in them before they are
seen by a camera (`training/closed_door_lesson.py`). Such views are sought, too, apart from the others, which stay as
they were, and are believed where they explain a cloud clearly better (docs/experiments.md, step 279). What no joint
does gives way to what any view says within the joint's limits, if that fits about as well (step 294).

A closed box still fits as well with another of its sides for the door. What it looks like says more (`box_turns`), if
that was taught: where a door is as training did not show it, and the box looks clearly righter in another way, it is
explained in that way (step 289).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import CAP, manhattan_frames
from articulate_ssl.inference.box_turns import VIEW_POINTS, BoxTurns
from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.inference.contest import CLEARLY, Contest
from articulate_ssl.inference.final_fit import ABOUT_AS_WELL, FinalFit
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.view_search import Seen, ViewSearch
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.hypotheses import Hypotheses


class OtherViews:
    """Tries what stands in the views, what lies, and what is closed.

    Args:
        final: How explanations are fitted in the end, by views and a registration.
        camera: Which way is up.
        closed: Views of doors that are nearly closed, if there are any.
        turns: Which way round boxes look right.
    """

    def __init__(self, final: FinalFit, camera: UprightCamera, closed: ViewSearch, turns: BoxTurns) -> None:
        self.final, self.camera, self.closed, self.turns = final, camera, closed, turns

    @property
    def lie(self) -> bool:
        """Whether some of the views lie, and it is known which way is up."""
        return bool(self.camera.learnt) and bool(self.final.view_search.quarters.any())

    def measure(self) -> None:
        """Find out at which joint state the door is closed, where views show that (`FinalFit.measure_closed`)."""
        if self.closed.learnt:
            self.final.measure_closed()

    def sought(
        self,
        one: Hypotheses,  # H = 1, in the clouds' proportions
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        votes: Votes | None,
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor, Votes | None]:  # H = 1, H = 1, [B]
        """Explanations, or what views of each kind say by themselves, where that fits better (`contest`)."""
        final, kinds = self.final, tuple(self._kinds())
        if not kinds:
            return one, rival, margin, votes
        contest, states = Contest(one, rival, margin, final.distance(one, points)), final.registration.states
        said = [views.search(points, shown=shown) for views, _, shown in kinds]
        for (views, lying, _), seen, tried in zip(kinds, said, self._fitted(said, points, dense), strict=True):
            error, likely = final.distance(tried, points), states.contains(tried.state[:, 0])
            if lying is not None:
                likely &= (self.camera.stood(tried.base[:, 0, :3, :3])[1] > 0) == lying
            known, least = states.contains(contest.one.state[:, 0]), CLEARLY if views is self.closed else 1.0
            contest, rows = contest.against(tried, error, likely, torch.where(known, least, ABOUT_AS_WELL))
            votes = votes._replace(share=votes.share.index_copy(0, rows, seen.votes.share[rows]))
        if self.turns.learnt and dense is not None:
            contest, votes = self._looking_right(contest, votes, points, dense)
        return contest.one, contest.rival, contest.margin, votes

    def _looking_right(self, contest: Contest, votes: Votes, points: Tensor, dense: Tensor) -> tuple[Contest, Votes]:
        """What is explained with a door as training did not show it gives way to what looks right, however either fits.

        Of what stands so in all views and in those of closed doors the one that fits better.
        """
        final, states = self.final, self.final.registration.states
        rows = (~states.showed(contest.one.state[:, 0])).nonzero()[:, 0]
        if not len(rows):
            return contest, votes
        frames, angle = manhattan_frames(dense[rows], torch.Generator().manual_seed(0))
        looks = self.turns.looks(dense[rows, :VIEW_POINTS], frames, seen=self._seen)
        turn, stood = looks.likeliest, self._upright.stood(contest.one.base[rows, 0, :3, :3])[0]
        other = looks.decided & (angle < CAP) & (angle_to(stood[:, None], turn)[:, 0] > ANOTHER_WAY)
        rows, turn, own = rows[other], turn[other], points[rows[other]]
        if not len(rows):
            return contest, votes
        won = torch.zeros_like(contest.margin, dtype=torch.bool)
        stand = [(views, (views.quarters == 0).nonzero()[:, 0]) for views in (final.view_search, self.closed)]
        said = [views.search(own, turn, shown) for views, shown in stand if len(shown)]
        for seen, tried in zip(said, self._fitted(said, own, dense[rows]), strict=True):
            right = angle_to(tried.base[..., :3, :3], turn)[:, 0] < ANOTHER_WAY
            likely = torch.zeros_like(won).index_copy(0, rows, right & states.contains(tried.state[:, 0]))
            error = torch.full_like(contest.error, torch.inf).index_copy(0, rows, final.distance(tried, own))
            everywhere = contest.one.with_rows(rows, tried)
            contest, better = contest.against(everywhere, error, likely, torch.where(won, 1.0, torch.inf))
            won = won.index_fill(0, better, True)
            share = votes.share.index_copy(0, rows, seen.votes.share)
            votes = votes._replace(share=votes.share.index_copy(0, better, share[better]))
        return contest, votes

    def _seen(self, rotation: Tensor) -> Tensor:
        """Whether a camera sees objects that are turned so, and stand."""
        _, quarters, stands = self._upright.stood(rotation)
        return self.final.registration.observation.allows(rotation) & stands & (quarters == 0)

    @property
    def _upright(self) -> UprightCamera:
        """Which way is up, as far as looks are concerned."""
        return self.camera if self.camera.learnt else self.turns.camera

    def _fitted(self, said: list[Seen], points: Tensor, dense: Tensor | None) -> tuple[Hypotheses, ...]:
        """What views of every kind say, in the clouds' proportions: all at once, which takes half as long."""
        final, kinds = self.final, len(said)
        if not kinds:
            return ()
        base, state = (torch.cat([getattr(seen, name)[:, :1] for seen in said]) for name in ("base", "state"))
        points, dense = points.repeat(kinds, 1, 1), None if dense is None else dense.repeat(kinds, 1, 1)
        tried, _ = final.registration.registered(final.articulated.category_at(base, state), points)
        tried = final.in_proportion(tried, points, dense)
        return tuple(tried.rows(rows) for rows in torch.arange(len(points), device=points.device).chunk(kinds))

    def _kinds(self) -> Iterator[tuple[ViewSearch, bool | None, Tensor | None]]:
        """Views, whether those that are sought lie, which these are; None is not known, and all."""
        for views in (self.final.view_search, self.closed):
            if self.lie and views.learnt:
                for lying in (False, True):
                    shown = ((views.quarters > 0) == lying).nonzero()[:, 0]
                    if len(shown):
                        yield views, lying, shown
            elif views is self.closed and views.learnt:
                yield views, None, None
