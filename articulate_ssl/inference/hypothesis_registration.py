"""Articulated registration of hypotheses at test time: shapes move onto the cloud without leaving their joints."""

from __future__ import annotations

import math

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import chamfer_l1, register_articulated
from articulate_ssl.inference.candidates import ANOTHER_WAY, Iteration, angle_to
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.observation import FAR, Observation


class HypothesisRegistration:
    """Registers hypotheses as options say.

    Args:
        options: Scales, rounds, and how many hypotheses are registered.
        observation: How clouds are taken.
        states: Which joint states training clouds showed.
    """

    def __init__(self, options: InferenceOptions, observation: Observation, states: StateRange) -> None:
        self.options, self.observation, self.states = options, observation, states

    @torch.no_grad()
    def register(
        self,
        candidates: Hypotheses,  # H of each cloud: where to start, and what is registered
        points: Tensor,  # [B, N, 3]
        scales: tuple[float, float] | None = None,
        rounds: int | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, H, 4, 4], [B, H, J], [B, H]
        """Register the predicted shapes to the clouds (`register_articulated`): base poses, joint states, errors.

        Args:
            scales: From coarse to fine; None are those of the options, as are the rounds.
        """
        options, count = self.options, candidates.base.shape[1]
        registered = register_articulated(
            candidates.articulated_shape(),
            points.repeat_interleave(count, dim=0),
            candidates.base.flatten(0, 1),
            candidates.state.flatten(0, 1),
            scales or (options.coarse_scale, options.fine_scale),
            rounds or options.rounds,
            self.observation.bidirectional,
        )
        return tuple(value.unflatten(0, (-1, count)) for value in registered)

    def leading(self, last: Iteration, points: Tensor, turn: Tensor | None) -> tuple[Hypotheses, Tensor]:
        """The leading hypotheses after registration, and their errors; with a turn [B, 3, 3], of those turned so."""
        ranked, rotation = last.ranked, last.hypotheses.base[..., :3, :3]
        if turn is not None:
            ranked = ranked + FAR * (angle_to(rotation, turn) > ANOTHER_WAY)
        leading = ranked.topk(min(self.options.candidates, ranked.shape[1]), largest=False).indices
        return self.registered(last.hypotheses.select(leading), points)

    def registered(
        self,
        candidates: Hypotheses,  # H = C
        points: Tensor,  # [B, N, 3]
    ) -> tuple[Hypotheses, Tensor]:  # H = C, [B, C]
        """Hypotheses after registration of their shapes, and their errors.

        Those of which a part was turned by more than `most_turned` stay as they were.
        """
        base, state, error = self.register(candidates, points)
        registered = candidates.at(base, state)
        if self.options.most_turned >= 180:
            return registered, error
        before, after = (some.object_pose()[..., :3, :3] for some in (candidates, registered))
        turned = roma.rotmat_geodesic_distance(before, after).amax(dim=-1)  # [B, C]
        kept = turned <= math.radians(self.options.most_turned)
        copies = points[:, None].expand(-1, error.shape[1], -1, -1).flatten(0, 1)
        own = chamfer_l1(copies, candidates.posed().flatten(0, 1).flatten(1, 2), self.observation.bidirectional)
        base = torch.where(kept[..., None, None], registered.base, candidates.base)
        state = torch.where(kept[..., None], registered.state, candidates.state)
        return candidates.at(base, state), torch.where(kept, error, own.view_as(error))

    def freed(
        self,
        one: Hypotheses,  # H = 1
        points: Tensor,  # [B, N, 3]
    ) -> Hypotheses:  # H = 1
        """Explanations registered again from other joint states, the best that is turned as before."""
        starts = self.states.starts().to(points)
        copies = one.select(torch.zeros(len(points), 1 + len(starts), dtype=torch.long, device=points.device))
        state = torch.cat([one.state, starts.expand(len(points), -1, -1)], dim=1)
        found, error = self.registered(copies.at(copies.base, state), points)
        away = angle_to(found.base[..., :3, :3], one.base[:, 0, :3, :3]) > ANOTHER_WAY
        return found.select(error.masked_fill(away, torch.inf).argmin(dim=1))
