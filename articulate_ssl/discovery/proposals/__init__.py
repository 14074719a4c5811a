"""Proposals: ways to split a template into pieces that may be parts.

A proposal is a module with one function, `propose(scene: Scene) -> list[Split]`, and is tried if
`DiscoveryOptions.proposals` names it. No proposal has to be right, or alone: of all splits the one stays that explains
the clouds best (`discovery.selection`).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.options import PROPOSALS, DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.shape.observation import Observation


class Scene(NamedTuple):
    """What a proposal may look at.

    Attributes:
        template: [T, 3] the cloud that is split.
        aligned: [n, N, 3] other clouds, roughly in its frame.
        num_parts: K.
        joint_type: `REVOLUTE` or `PRISMATIC`.
        options: How much work to do.
        observation: How far objects are turned.
        generator: Of everything random.
        framed: Whether template and clouds stand in a frame that all have in common, along its axes.
        same_object: Whether all show one object, and none is deeper than another.
    """

    template: Tensor
    aligned: Tensor
    num_parts: int
    joint_type: int
    options: DiscoveryOptions
    observation: Observation
    generator: torch.Generator
    framed: bool = False
    same_object: bool = False

    @property
    def thin(self) -> Tensor:
        """[n, options.points, 3] the aligned clouds with as many points as registration reads."""
        return self.aligned[:, : self.options.points]


class Split(NamedTuple):
    """A split of the template.

    Attributes:
        label: [T] int64 pieces 0..K-1.
        refined: Whether points are given to the piece that explains them best while pieces are registered. What is cut
            small on purpose would drown in that.
        registered: How the pieces move, and where they are in the aligned clouds, if the proposal found that too.
    """

    label: Tensor
    refined: bool
    registered: RegisteredShape | None = None


Proposal = Callable[[Scene], list[Split]]


def load_proposals(names: list[str]) -> list[Proposal]:
    """The proposals that the options name.

    Raises:
        ValueError: if there is no such proposal.
    """
    return [_load(name) for name in names]


def _load(name: str) -> Proposal:
    try:
        return import_module(name if "." in name else f"{__name__}.{name}").propose
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"no proposal {name!r} for part discovery ({error}); choose from {', '.join(PROPOSALS)}, or name a module "
            "that has a function `propose` as package.module"
        ) from error
