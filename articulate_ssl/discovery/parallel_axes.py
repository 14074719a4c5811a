"""One direction for all joints of an object, as the paper assumes.

What a part's shape leaves open, as about which line a lamp's round head turns, the other joints decide.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape

_AS_MUCH = 1e-3  # of the cosines: two joints agree with each other as much as each of them does


def with_parallel_axes(
    found: RegisteredShape,
    clouds: Tensor,  # [n, N, 3] that it is registered to
    options: DiscoveryOptions,
) -> RegisteredShape:
    """The same with the direction of the joint which the others agree with most; of several, which explains most."""
    axes = found.shape.joints.axis
    agreement = (axes @ axes.mT).abs().sum(dim=1)
    likely = axes[agreement > agreement.max() - _AS_MUCH]
    if len(likely) == 1:
        return found.with_parallel_axes(likely[0])
    best = found.error.argsort()[: options.kept(min(options.search_clouds, len(clouds)))]
    errors = []
    for direction in likely:
        fit = found.of_clouds(best).with_parallel_axes(direction).fit(torch.Generator().manual_seed(options.seed))
        fit.optimise(clouds[best], options.cycles, shared=False)
        errors.append(fit.error(clouds[best]).mean())
    return found.with_parallel_axes(likely[torch.stack(errors).argmin()])
