"""Slabs at either end of each principal axis; doors are slabs."""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.proposals import Scene, Split
from articulate_ssl.discovery.proposals.random_cuts import cut_off
from articulate_ssl.shape.stretch import principal_frame

_SHARES = (0.1, 0.2)  # of the template's points


def propose(scene: Scene) -> list[Split]:
    """A thin and a thick slab at every end."""
    return [Split(label, refined=False) for label in slab_cuts(scene.template, scene.num_parts, scene.generator)]


def slab_cuts(template: Tensor, num_parts: int, generator: torch.Generator) -> list[Tensor]:
    """[T] labels that part a slab from the rest."""
    height = template @ principal_frame(template)[:3, :3].T
    slabs = [sign * h for h in height.T for sign in (-1, 1)]
    return [cut_off(template, slab, share, num_parts, generator) for slab in slabs for share in _SHARES]
