"""Which of two explanations of a cloud is right, where that was learnt: by relief, by networks, or by all of them.

Where a category's clouds can be explained in two ways that fit alike, the winner has a twin (`two_ways`), and the
relief of the surface decides (`relief`), with networks if they were taught (`surface_decision`, `swapped_parts`). Where
fits tell explanations apart, a network that they taught decides between the winner and its rival.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.inference.candidates import frames_of, likelier
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.relief import relief_of
from articulate_ssl.inference.swapped_parts import (
    SIZE,
    PartViews,
    exchanged_parts,
    log_odds_from_near,
    views_of_parts,
)
from articulate_ssl.inference.two_ways import TwoWays
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.hypotheses import Hypotheses


class BothWays(NamedTuple):
    """What tells the two explanations of clouds apart.

    Attributes:
        frames: [B, 2, 3, 3] of explanations and of their twins, object -> camera.
        reliefs: [B, F] and [B, F] of both, in each version of the clouds.
        views: Of parts that the twin has exchanged, in all versions; None where it exchanges none.
    """

    frames: Tensor
    reliefs: list[tuple[Tensor, Tensor]]
    views: PartViews | None


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
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Of the two explanations of clouds the one that their relief favours, the other, and by how much.

        Networks that were taught have a say, too.
        """
        twin, two_ways = self.twin(one, points, registers), self.two_ways
        odds = two_ways.relief_odds(self.relief(one, dense), self.relief(twin, dense))
        if two_ways.surface is not None:
            odds = odds + two_ways.surface.log_odds(frames_of(one, twin), dense)
        if two_ways.near is not None:
            odds = odds + log_odds_from_near(two_ways.near, self._views(one, twin, (dense,)))
        return likelier(odds, one, twin, two_ways.temperature)

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

    def both_ways(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
        dense: Sequence[Tensor],  # of [B, P, 3] the same clouds with all their points, as they are and with noise
    ) -> BothWays:
        """What is seen of explanations and of their twins."""
        twin = self.twin(one, points, registers=True)
        reliefs = [(self.relief(one, some), self.relief(twin, some)) for some in dense]
        return BothWays(frames_of(one, twin), reliefs, self._views(one, twin, dense))

    def _views(self, one: Hypotheses, twin: Hypotheses, dense: Sequence[Tensor]) -> PartViews | None:
        near, slot = self.two_ways.near, self.two_ways.slot
        exchanged = exchanged_parts(one.chain, one.structure.joint_type, slot.tolist())
        if exchanged is None:
            return None
        return views_of_parts(one, twin, slot, exchanged, dense, SIZE.read if near is None else near.size.read)

    def relief(
        self,
        one: Hypotheses,  # H = 1
        dense: Tensor,  # [B, P, 3]
    ) -> Tensor:  # [B, K * NUM_FEATURES]
        """The relief of clouds under an explanation of each (`describe_relief`)."""
        return relief_of(one, self.articulated.category.canonical().shape, dense)
