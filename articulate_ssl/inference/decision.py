"""Which of two explanations of a cloud is right, where that was learnt: by relief, by a network, or by both.

Where a category's clouds can be explained in two ways that fit alike, the winner has a twin (`two_ways`), and the
relief of the surface decides (`relief`), with a network if one was taught (`surface_decision`). Where fits tell
explanations apart, a network that they taught decides between the winner and its rival.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from articulate_ssl.inference.candidates import frames_of, likelier
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.relief import relief_of
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.inference.two_ways import TwoWays
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.hypotheses import Hypotheses


class Decision:
    """Decides between two explanations.

    Args:
        articulated: The network, for the category's own shape.
        registration: Of hypotheses.
        two_ways: What was learnt.
    """

    def __init__(
        self, articulated: ArticulatedNetwork, registration: HypothesisRegistration, two_ways: TwoWays
    ) -> None:
        self.articulated, self.registration, self.two_ways = articulated, registration, two_ways

    def by_relief(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3]
        registers: bool,
        surface: SurfaceDecision | None = None,
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Of the two explanations of clouds the one that their relief favours, the other, and by how much.

        Args:
            surface: Has a say, too.
        """
        twin, temperature = self.twin(one, points, registers), 1.0
        odds = self.two_ways.relief_odds(self.relief(one, dense), self.relief(twin, dense))
        if surface is not None:
            odds, temperature = odds + surface.log_odds(frames_of(one, twin), dense), surface.temperature
        return likelier(odds, one, twin, temperature)

    def by_surface(
        self,
        one: Hypotheses,  # H = 1
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3]
        registers: bool,
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """See `by_relief`, by the network alone: of explanations and their rivals; what has no rival stays as it is.

        A rival that is preferred fitted worse, mostly as its joints got stuck: it is registered again from others.
        """
        frames = frames_of(one, rival)
        surface = self.two_ways.surface
        chosen, other, decided = likelier(surface.log_odds(frames, dense), one, rival, surface.temperature)
        alone = (frames[:, 0] == frames[:, 1]).flatten(1).all(dim=1)
        stuck = (chosen.base != one.base).flatten(1).any(dim=1).nonzero()[:, 0]
        if registers and len(stuck):
            freed = self.registration.freed(chosen.rows(stuck), points[stuck])
            chosen = chosen.at(
                chosen.base.index_copy(0, stuck, freed.base), chosen.state.index_copy(0, stuck, freed.state)
            )
        return chosen, other, torch.where(alone, margin, decided)

    def twin(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        registers: bool,
    ) -> Hypotheses:
        """The other explanation of clouds that have two, registered or as it follows from the one."""
        pose = self.two_ways.twin_poses(one.object_pose()[:, 0])
        state = one.articulated_shape().read_states(pose)
        start = one.at(pose[:, None, one.chain.root], state[:, None])
        if not registers:
            return start
        base, state, _ = self.registration.register(start, points)
        return one.at(base, state)

    def reliefs(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        dense: Sequence[Tensor],  # of [B, P, 3] the same clouds with all their points
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:  # [B, 2, 3, 3], of [B, F], [B, F]
        """The frames of explanations and of their twins (object -> camera); the relief of both, in each of `dense`."""
        twin = self.twin(one, points, registers=True)
        return frames_of(one, twin), [(self.relief(one, some), self.relief(twin, some)) for some in dense]

    def relief(
        self,
        one: Hypotheses,  # H = 1
        dense: Tensor,  # [B, P, 3]
    ) -> Tensor:  # [B, K * NUM_FEATURES]
        """The relief of clouds under an explanation of each (`describe_relief`)."""
        return relief_of(one, self.articulated.category.canonical().shape, dense)
