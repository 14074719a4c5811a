"""Explanations of depth views by what few views show, or none: objects hinged at another side, and closed doors.

A view of an object that is hinged elsewhere than most (`hinge_sides`) is often more like one of the many others. Once
either explanation has the cloud's proportions, errors tell better: of 40 views of ovens that are hinged at the side 35
are right then (docs/experiments.md, step 246). So both are always sought, where simulated views and a camera know both.

Training shows doors that are open, and users scan closed ones, which no view was like: another side of a box was taken
for an open door. But scans show whole objects, and a door whose hinge is known can be closed in them before they are
seen by a camera (`training/closed_door_lesson.py`). Such views are sought, too, apart from the others, which stay as
they were, and are believed where they explain a cloud clearly better (docs/experiments.md, step 279). What no joint
does gives way to what any view says within the joint's limits, if that fits about as well (step 294).

A closed box still fits about as well with another of its sides for the door. So where closed doors were taught, and
what boxes look like (`box_turns`), a box is explained in every way that is square to its faces and that a camera sees.
What decides is how far the view is from an explanation, how far the explanation reaches into free space (`free_space`),
and how right the box looks in that way: none of the three says enough by itself (step 307).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import CAP, manhattan_frames
from articulate_ssl.inference.box_turns import VIEW_POINTS, BoxTurns
from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.inference.contest import CLEARLY, Contest
from articulate_ssl.inference.final_fit import ABOUT_AS_WELL, FinalFit
from articulate_ssl.inference.free_space import FreeSpace
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.view_search import Seen, ViewSearch
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.hypotheses import Hypotheses

# How much reaching into free space counts; by what share of its error an explanation may be worse for every unit that
# its way looks likelier, as a logarithm; so much less likely does a way count at most, or one that is square to no
# face. From .5 to 1 and from .03 to .05 decide alike (docs/experiments.md, step 307). Chosen there.
_REACHES, _LOOKS, _UNLIKELY = 0.5, 0.03, 6.0


class Sought(NamedTuple):
    """What is decided for in the end, of B clouds.

    Attributes:
        one: H = 1, in the clouds' proportions.
        rival: H = 1, the best that is turned another way.
        margin: [B] how much worse the rival fits, at most.
        votes: Which parts points are of.
        error: [B] by which `one` was decided for.
    """

    one: Hypotheses
    rival: Hypotheses
    margin: Tensor
    votes: Votes | None
    error: Tensor


class OtherViews:
    """Tries what stands in the views, what lies, and what is closed.

    Args:
        final: How explanations are fitted in the end, by views and a registration.
        camera: Which way is up.
        closed: Views of doors that are nearly closed, if there are any.
        turns: Which way round boxes look right.

    Attributes:
        reaches: How much reaching into free space counts; 0 leaves it out.
    """

    def __init__(self, final: FinalFit, camera: UprightCamera, closed: ViewSearch, turns: BoxTurns) -> None:
        self.final, self.camera, self.closed, self.turns, self.reaches = final, camera, closed, turns, _REACHES

    @property
    def lie(self) -> bool:
        """Whether some of the views lie, and it is known which way is up."""
        return bool(self.camera.learnt) and bool(self.final.view_search.quarters.any())

    @property
    def every_way(self) -> bool:
        """Whether boxes are explained in every way, as closed doors and looks were taught."""
        return self.closed.learnt and self.turns.learnt

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
    ) -> Sought:
        """Explanations, or what views of each kind say by themselves, where that fits better (`contest`)."""
        final, kinds = self.final, tuple(self._kinds())
        error = final.distance(one, points)
        if not kinds:
            return Sought(one, rival, margin, votes, error)
        contest, states = Contest(one, rival, margin, error), final.registration.states
        said = [views.search(points, shown=shown) for views, _, shown in kinds]
        for (views, lying, _), seen, tried in zip(kinds, said, self._fitted(said, points, dense), strict=True):
            error, likely = final.distance(tried, points), states.contains(tried.state[:, 0])
            if lying is not None:
                likely &= (self.camera.stood(tried.base[:, 0, :3, :3])[1] > 0) == lying
            known, least = states.contains(contest.one.state[:, 0]), CLEARLY if views is self.closed else 1.0
            contest, rows = contest.against(tried, error, likely, torch.where(known, least, ABOUT_AS_WELL))
            votes = votes._replace(share=votes.share.index_copy(0, rows, seen.votes.share[rows]))
        if self.every_way and dense is not None:
            contest, votes = self._in_every_way(contest, votes, points, dense)
        return Sought(contest.one, contest.rival, contest.margin, votes, contest.error)

    def _in_every_way(self, contest: Contest, votes: Votes, points: Tensor, dense: Tensor) -> tuple[Contest, Votes]:
        """Of all ways that are square to boxes' faces the one that is likeliest by fits, free space and looks.

        In the way that the best so far is turned no other is sought: views of both kinds had their say there.
        """
        final, space = self.final, FreeSpace.of(dense)
        rotation, likely = self._ways(dense)
        away = angle_to(rotation, self._upright.stood(contest.one.base[:, 0, :3, :3])[0])
        contest = contest._replace(error=self._error(contest.one, points, space, _looks_of(away, likely)))
        row, way = (likely.isfinite() & (away > ANOTHER_WAY)).nonzero().unbind(1)
        if not len(row):
            return contest, votes
        turn, own = rotation[row, way], points[row]
        stand = [(views, (views.quarters == 0).nonzero()[:, 0]) for views in (final.view_search, self.closed)]
        said = [views.search(own, turn, shown) for views, shown in stand if len(shown)]
        for seen, tried in zip(said, self._fitted(said, own, dense[row]), strict=True):
            error = torch.full_like(likely, torch.inf)
            error[row, way] = self._error(tried, own, space.rows(row), likely[row, way])
            allowed = torch.zeros_like(likely, dtype=torch.bool)
            turned = angle_to(tried.base[..., :3, :3], turn)[:, 0] < ANOTHER_WAY
            allowed[row, way] = turned & final.registration.states.contains(tried.state[:, 0])
            for each in allowed.any(dim=0).nonzero()[:, 0]:
                of = (way == each).nonzero()[:, 0]
                everywhere = contest.one.with_rows(row[of], tried.rows(of))
                contest, rows = contest.against(everywhere, error[:, each], allowed[:, each])
                share = votes.share.index_copy(0, row[of], seen.votes.share[of])
                votes = votes._replace(share=votes.share.index_copy(0, rows, share[rows]))
        return contest, votes

    def _error(self, one: Hypotheses, points: Tensor, space: FreeSpace, looks: Tensor) -> Tensor:  # [B]
        """Distances of views from explanations, and of these from views in free space; more, the less right they look.

        Args:
            looks: [B] logarithms.
        """
        error = self.final.distance(one, points) + self.reaches * space.entered(one.posed()[:, 0].flatten(1, 2))
        return error * (-_LOOKS * looks).exp()

    def _ways(self, dense: Tensor) -> tuple[Tensor, Tensor]:  # [B, 24, 3, 3], [B, 24]
        """In which boxes may be turned, and by how much each looks less right than the best; -inf if no camera sees it.

        What is square to nothing may be turned in none.
        """
        frames, angle = manhattan_frames(dense, torch.Generator().manual_seed(0))
        looks = self.turns.looks(dense[:, :VIEW_POINTS], frames, seen=self._seen)
        seen = (looks.likely > -torch.inf) & (angle < CAP)[:, None]
        likely = looks.likely - looks.likely.amax(dim=1, keepdim=True)
        return looks.rotation, likely.clamp(min=-_UNLIKELY).masked_fill(~seen, -torch.inf)

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


def _looks_of(
    away: Tensor,  # [B, W] radians, of what is explained from every way
    likely: Tensor,  # [B, W], -inf: not at all
) -> Tensor:  # [B]
    """How right it looks: as the way that is about so, if there is one."""
    least, way = away.masked_fill(likely.isinf(), torch.inf).min(dim=1)
    found = likely.gather(1, way[:, None])[:, 0]
    return torch.where(least < ANOTHER_WAY, found, -_UNLIKELY)
