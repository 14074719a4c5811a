"""Explanations of depth views by objects that are hinged at another side, where simulated views and a camera know both.

Few of the simulated views lie, as few objects are hinged elsewhere than most (`hinge_sides`), and a view of such an
object is often more like one of the many others: by the search alone half of the ovens that are hinged at the side were
explained as others. Once either explanation has the cloud's proportions, errors tell better: two in three are right
then, and no other is wrong for it (docs/experiments.md, step 242).
"""

from __future__ import annotations

from torch import Tensor

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
        if not (views.learnt and self.camera.learnt):
            return one, rival, margin, votes
        first, lies, shown = one, self._lies(one.base[:, 0]), self._lies(views.base.to(points))
        for lying in (False, True):
            rows, among = (lies != lying).nonzero()[:, 0], (shown == lying).nonzero()[:, 0]
            if not len(rows) or not len(among):
                continue
            own, before = points[rows], first.rows(rows)
            seen = views.search(own, shown=among)
            start = final.articulated.category_at(seen.base[:, :1], seen.state[:, :1])
            tried, _ = final.registration.registered(start, own)
            tried = final.in_proportion(tried, own, None if dense is None else dense[rows])
            error, worse = final.distance(tried, own), final.distance(before, own)
            likely = final.registration.states.contains(tried.state[:, 0]) & (self._lies(tried.base[:, 0]) == lying)
            fits = (likely & (error < worse)).nonzero()[:, 0]
            better = rows[fits]
            one, rival = one.with_rows(better, tried.rows(fits)), rival.with_rows(better, before.rows(fits))
            margin = margin.index_copy(0, better, 1 - error[fits] / worse[fits])
            votes = votes._replace(share=votes.share.index_copy(0, better, seen.votes.share[fits]))
        return one, rival, margin, votes

    def _lies(self, base: Tensor) -> Tensor:
        """Whether what stands in a frame [..., 4, 4] -> camera is hinged elsewhere than most: [...] bool."""
        return self.camera.stood(base[..., :3, :3])[1] > 0
