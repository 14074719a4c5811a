"""The whole network under the paper's objective, and one step of its training."""

from __future__ import annotations

from collections.abc import Callable

import torch

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.workload import random_clouds
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.module import ArticulatedPoseModule


def build_module(machine: Machine, options: NetworkOptions, parts: int = 2) -> ArticulatedPoseModule:
    """A module under the paper's objective, without a trainer."""
    torch.manual_seed(0)
    module = ArticulatedPoseModule("benchmark", parts, recipe="paper", network=options)
    module.articulated.mixed_precision = machine.precision == "bf16"  # a step casts nothing else, whatever it runs in
    module.log_dict = lambda *args, **kwargs: None  # there is no trainer to log to
    return module.to(machine.device)


def training_step(
    machine: Machine, options: NetworkOptions, batch: int, num_points: int, parts: int = 2
) -> Callable[[], None]:
    """Forward, loss of the paper's objective, backward and optimiser step."""
    module = build_module(machine, options, parts)
    optimizer = module.configure_optimizers()["optimizer"]
    clouds = {"points": random_clouds(machine, batch, num_points)}

    def step() -> None:
        optimizer.zero_grad()
        module.training_step(clouds, 0).backward()
        optimizer.step()

    return step
