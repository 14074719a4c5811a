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
from articulate_ssl.shape.articulated_shape import ArticulatedShape
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
        base, state, _ = search_articulated(shape, clouds, self.rotations, state_starts(found.state))
        copies = clouds.repeat_interleave(base.shape[1], dim=0)
        fit = InstanceFit(shape, base.flatten(0, 1), state.flatten(0, 1), self.generator)
        fit.optimise(copies, few_cycles, shared=False)
        # A hypothesis that leaves a part unexplained is to pay for it.
        error = fit.error(copies, softened=False).unflatten(0, base.shape[:2])
        best = self.observation.ranked(error, base[..., :3, :3]).argmin(dim=1)
        base, state = (_chosen(value, best) for value in (fit.base, fit.state))
        fit = InstanceFit(shape, base, state, self.generator)
        fit.optimise(clouds, 2 * few_cycles, shared=False)
        registered = replace(RegisteredShape.of(fit, clouds), shape=found.shape, sought=shape.joints.limits)
        return registered.turned_to_mean() if self.observation.orientation.limited else registered


@dataclass(frozen=True)
class SlidingRegistrar(Registrar):
    """In a common frame, parts that slide along one of its axes: their places are read off, then stretched."""

    def register(self, found: RegisteredShape, clouds: Tensor) -> RegisteredShape:
        """See `fit_slides`."""
        options = self.options
        fit = fit_slides(found.limited(), found.axes, clouds, options.points, options.few_cycles, self.generator)
        return replace(RegisteredShape.of(fit, clouds), shape=found.shape)


def fit_slides(
    shape: ArticulatedShape,
    axes: Tensor,  # [K, 3, 3] columns along which parts stretch
    clouds: Tensor,  # [n, N, 3] in a frame common to them and the shape
    num_points: int,
    cycles: int,
    generator: torch.Generator,
) -> InstanceFit:
    """Place a shape whose parts slide, stretch the candidates, choose, stretch the chosen for longer.

    Args:
        num_points: Of the shape, whose offsets are tried.
        cycles: Of the descent on candidates; twice as many on the chosen.
        generator: Of the points that are drawn in it.
    """
    placed = place(shape, clouds, num_points)
    copies = clouds.repeat_interleave(placed.base.shape[1], dim=0)
    base, state, log_stretch = (value.flatten(0, 1) for value in placed)
    fit = InstanceFit(shape, base, state, generator, axes, log_stretch)
    fit.optimise(copies, cycles, shared=False)
    best = fit.error(copies, softened=False).unflatten(0, placed.base.shape[:2]).argmin(dim=1)
    base, state, log_stretch = (_chosen(value, best) for value in (fit.base, fit.state, fit.log_stretch))
    fit = InstanceFit(shape, base, state, generator, axes, log_stretch)
    fit.optimise(clouds, 2 * cycles, shared=False)
    return fit


def _chosen(candidates: Tensor, best: Tensor) -> Tensor:
    """Of n C candidates, cloud by cloud, the one of each cloud that is best, [n]."""
    return candidates.unflatten(0, (len(best), -1))[torch.arange(len(best), device=best.device), best]


def state_starts(state: Tensor) -> Tensor:
    """The middle, and every combination of either side: [1 + 2^J, J]."""
    spread = _STATE_STARTS * state.std(dim=0)
    states = torch.cartesian_prod(*torch.stack([-spread, spread], dim=-1)).view(-1, len(spread))
    return torch.cat([torch.zeros_like(states[:1]), states])
