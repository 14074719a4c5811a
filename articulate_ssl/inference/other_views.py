"""Explanations of depth views by what few views show, or none: objects hinged at another side, and closed doors.

A view of an object that is hinged elsewhere than most (`hinge_sides`) is often more like one of the many others. Once
either explanation has the cloud's proportions, errors tell better: of 40 views of ovens that are hinged at the side 35
are right then (docs/experiments.md, step 246). So both are always sought, where simulated views and a camera know both.

Training shows doors that are open, and users scan closed ones, which no view was like: another side of a box was taken
for an open door. But scans show whole objects, and a door whose hinge is known can be closed in them before they are
seen by a camera (`training/closed_door_lesson.py`). Such views are sought, too, apart from the others, which stay as
they were, and are believed where they explain a cloud clearly better (docs/experiments.md, step 279).
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from articulate_ssl.inference.contest import CLEARLY, Contest
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.hypotheses import Hypotheses


class OtherViews:
    """Tries what stands in the views, what lies, and what is closed.

    Args:
        final: How explanations are fitted in the end, by views and a registration.
        camera: Which way is up.
        closed: Views of doors that are nearly closed, if there are any.
    """

    def __init__(self, final: FinalFit, camera: UprightCamera, closed: ViewSearch) -> None:
        self.final, self.camera, self.closed = final, camera, closed

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
        contest = Contest(one, rival, margin, final.distance(one, points))
        for views, lying, shown in kinds:
            seen = views.search(points, shown=shown)
            start = final.articulated.category_at(seen.base[:, :1], seen.state[:, :1])
            tried, _ = final.registration.registered(start, points)
            tried = final.in_proportion(tried, points, dense)
            likely = final.registration.states.contains(tried.state[:, 0])
            if lying is not None:
                likely &= (self.camera.stood(tried.base[:, 0, :3, :3])[1] > 0) == lying
            least = CLEARLY if views is self.closed else 1.0
            contest, rows = contest.against(tried, final.distance(tried, points), likely, least)
            votes = votes._replace(share=votes.share.index_copy(0, rows, seen.votes.share[rows]))
        return contest.one, contest.rival, contest.margin, votes

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
