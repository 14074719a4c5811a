"""From a shape that fits some clouds to where and how it is in others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.discovery.slide_table import place
from articulate_ssl.shape.observation import Observation

_STATE_STARTS = 1.5  # standard deviations of the states, on either side of their middle, from which a search starts


@dataclass(frozen=True)
class Registrar(ABC):
    """Registers a shape to clouds.

    Attributes:
        options: How much work to do.
        generator: Of everything random.
    """

    options: DiscoveryOptions
    generator: torch.Generator

    @abstractmethod
    def register(
        self,
        found: RegisteredShape,
        clouds: Tensor,  # [n, N, 3]
    ) -> RegisteredShape:
        """The shape of a registration, registered to other clouds."""


@dataclass(frozen=True)
class SearchingRegistrar(Registrar):
    """In any orientation: of a search's candidates, the one that fits best when stretched.

    Attributes:
        rotations: [H, 3, 3] from which clouds are searched.
        observation: How far objects are turned.
    """

    rotations: Tensor
    observation: Observation

    def register(self, found: RegisteredShape, clouds: Tensor) -> RegisteredShape:
        """Search, stretch the candidates, choose, stretch the chosen for longer."""
        few_cycles = self.options.few_cycles
        shape = found.limited()
        base, state, _ = search_articulated(shape, clouds, self.rotations, _state_starts(found.state))
        copies = clouds.repeat_interleave(base.shape[1], dim=0)
        fit = InstanceFit(shape, base.flatten(0, 1), state.flatten(0, 1), self.generator)
        fit.optimise(copies, few_cycles, shared=False)
        # A hypothesis that leaves a part unexplained is to pay for it.
        error = fit.error(copies, softened=False).unflatten(0, base.shape[:2])
        best = self.observation.ranked(error, base[..., :3, :3]).argmin(dim=1)
        base, state = (_chosen(value, best) for value in (fit.base, fit.state))
        fit = InstanceFit(shape, base, state, self.generator)
        fit.optimise(clouds, 2 * few_cycles, shared=False)
        registered = replace(RegisteredShape.of(fit, clouds), shape=found.shape)
        return registered.turned_to_mean() if self.observation.orientation.limited else registered


@dataclass(frozen=True)
class SlidingRegistrar(Registrar):
    """In a common frame, parts that slide along one of its axes: their places are read off, then stretched."""

    def register(self, found: RegisteredShape, clouds: Tensor) -> RegisteredShape:
        """Place, stretch the candidates, choose, stretch the chosen for longer."""
        few_cycles, shape = self.options.few_cycles, found.limited()
        placed = place(found.shape, clouds, self.options.points)
        copies = clouds.repeat_interleave(placed.base.shape[1], dim=0)
        base, state, log_stretch = (value.flatten(0, 1) for value in placed)
        fit = InstanceFit(shape, base, state, self.generator, found.axes, log_stretch)
        fit.optimise(copies, few_cycles, shared=False)
        best = fit.error(copies, softened=False).unflatten(0, placed.base.shape[:2]).argmin(dim=1)
        base, state, log_stretch = (_chosen(value, best) for value in (fit.base, fit.state, fit.log_stretch))
        fit = InstanceFit(shape, base, state, self.generator, found.axes, log_stretch)
        fit.optimise(clouds, 2 * few_cycles, shared=False)
        return replace(RegisteredShape.of(fit, clouds), shape=found.shape)


def _chosen(candidates: Tensor, best: Tensor) -> Tensor:
    """Of n C candidates, cloud by cloud, the one of each cloud that is best, [n]."""
    return candidates.unflatten(0, (len(best), -1))[torch.arange(len(best), device=best.device), best]


def _state_starts(state: Tensor) -> Tensor:
    """The middle, and every combination of either side: [1 + 2^J, J]."""
    spread = _STATE_STARTS * state.std(dim=0)
    states = torch.cartesian_prod(*torch.stack([-spread, spread], dim=-1)).view(-1, len(spread))
    return torch.cat([torch.zeros_like(states[:1]), states])
