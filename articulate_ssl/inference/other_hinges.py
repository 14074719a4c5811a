"""Explanations of depth views by objects that are hinged at another side, where simulated views and a camera know both.

A view of an object that is hinged elsewhere than most (`hinge_sides`) is often more like one of the many others. Once
either explanation has the cloud's proportions, errors tell better: of 40 views of ovens that are hinged at the side 35
are right then (docs/experiments.md, step 246). So both are always sought.
"""

from __future__ import annotations

from torch import Tensor

from articulate_ssl.inference.contest import Contest
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.hypotheses import Hypotheses


class OtherHinges:
    """Tries what stands in the views, and what lies.

    Args:
        final: How explanations are fitted in the end, by views and a registration.
        camera: Which way is up.
    """

    def __init__(self, final: FinalFit, camera: UprightCamera) -> None:
        self.final, self.camera = final, camera

    @property
    def known(self) -> bool:
        """Whether some of the views lie, and it is known which way is up."""
        return bool(self.camera.learnt) and bool(self.final.view_search.quarters.any())

    def sought(
        self,
        one: Hypotheses,  # H = 1, in the clouds' proportions
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        votes: Votes | None,
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor, Votes | None]:  # H = 1, H = 1, [B]
        """Explanations, or what views of either kind say by themselves, where that fits better (`contest`)."""
        final, views = self.final, self.final.view_search
        if not self.known:
            return one, rival, margin, votes
        contest = Contest(one, rival, margin, final.distance(one, points))
        for lying in (False, True):
            shown = ((views.quarters > 0) == lying).nonzero()[:, 0]
            if not len(shown):
                continue
            seen = views.search(points, shown=shown)
            start = final.articulated.category_at(seen.base[:, :1], seen.state[:, :1])
            tried, _ = final.registration.registered(start, points)
            tried = final.in_proportion(tried, points, dense)
            likely = final.registration.states.contains(tried.state[:, 0])
            likely &= (self.camera.stood(tried.base[:, 0, :3, :3])[1] > 0) == lying
            contest, rows = contest.against(tried, final.distance(tried, points), likely)
            votes = votes._replace(share=votes.share.index_copy(0, rows, seen.votes.share[rows]))
        return contest.one, contest.rival, contest.margin, votes
