"""Explanations of depth views by objects that are hinged at another side, where simulated views and a camera know both.

Few of the simulated views lie, as few objects are hinged elsewhere than most (`hinge_sides`), and a view of such an
object is often more like one of the many others: by the search alone half of the ovens that are hinged at the side were
explained as others. Once either explanation has the cloud's proportions, errors tell better: two in three are right
then, and no other is wrong for it (docs/experiments.md, step 242).
"""

from __future__ import annotations

from torch import Tensor

from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.hypotheses import Hypotheses


class OtherHinges:
    """Tries, of what is explained standing, what lies, and the other way round.

    Args:
        final: How explanations are fitted in the end, by views and a registration.
        camera: Which way is up.
    """

    def __init__(self, final: FinalFit, camera: UprightCamera) -> None:
        self.final, self.camera = final, camera

    @property
    def known(self) -> bool:
        """Whether there are views, and it is known which of them lie."""
        return self.final.view_search.learnt and bool(self.camera.learnt)

    def sought(
        self,
        one: Hypotheses,  # H = 1, in the clouds' proportions
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        votes: Votes | None,
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor, Votes | None]:  # H = 1, H = 1, [B]
        """Explanations, or what those of the views say that are hinged otherwise, where that fits better.

        What gave way is the rival then, and the margin how much worse it fits.
        """
        final, views = self.final, self.final.view_search
        if not self.known:
            return one, rival, margin, votes
        error, shown = final.distance(one, points), self._lies(views.base.to(points))
        for lying in (False, True):
            among = (shown == lying).nonzero()[:, 0]
            if not len(among):
                continue
            seen = views.search(points, shown=among)
            start = final.articulated.category_at(seen.base[:, :1], seen.state[:, :1])
            tried, _ = final.registration.registered(start, points)
            tried = final.in_proportion(tried, points, dense)
            tried_error = final.distance(tried, points)
            likely = final.registration.states.contains(tried.state[:, 0]) & (self._lies(tried.base[:, 0]) == lying)
            rows = (likely & (tried_error < error)).nonzero()[:, 0]
            turned = angle_to(tried.base[:, :, :3, :3], one.base[:, 0, :3, :3])[:, 0] > ANOTHER_WAY
            gave_way = (likely & (tried_error < error) & turned).nonzero()[:, 0]
            rival = rival.with_rows(gave_way, one.rows(gave_way))
            margin = margin.index_copy(0, gave_way, 1 - tried_error[gave_way] / error[gave_way])
            one, error = one.with_rows(rows, tried.rows(rows)), error.index_copy(0, rows, tried_error[rows])
            votes = votes._replace(share=votes.share.index_copy(0, rows, seen.votes.share[rows]))
        return one, rival, margin, votes

    def _lies(self, base: Tensor) -> Tensor:
        """Whether what stands in a frame [..., 4, 4] -> camera is hinged elsewhere than most: [...] bool."""
        return self.camera.stood(base[..., :3, :3])[1] > 0
