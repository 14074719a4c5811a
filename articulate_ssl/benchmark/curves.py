"""Training with the fast backbone and with its twin: loss of 200 steps from the same seed, one curve over the other.

    python -m articulate_ssl.benchmark.curves docs/images/fast_vs_twin.png

Training is chaotic: differences in the last digit grow until they reach the size of the loss's noise. A third run, the
fast backbone with every weight moved by about one digit of float32, shows how far that goes without any twin.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.original_backbone import OriginalBackbone
from articulate_ssl.benchmark.training_step import build_module
from articulate_ssl.network.options import NetworkOptions

STEPS = 200
LAST = 20  # steps that the final loss is averaged over
ROUNDING = 1e-7


def training_curves(machine: Machine, steps: int = STEPS) -> dict[str, list[float]]:
    """Loss of every step with the fast backbone, with the twin, and with the fast one started a rounding away."""
    options = NetworkOptions(
        group_order=12,
        dims=[16, 32, 64],
        radii=[0.12, 0.2, 0.3],
        num_neighbors=16,
        num_kernel_points=13,
        head_dim=32,
        shape_points=64,
    )
    curves = {}
    for name in ("fast", "twin", "fast, weights moved by 1e-7"):
        module = build_module(machine, options)
        optimizer = torch.optim.Adam(module.parameters(), 2e-3)
        generator = torch.Generator().manual_seed(1)
        if name == "twin":
            module.articulated.backbone = OriginalBackbone(module.articulated.backbone)
        elif name != "fast":
            for parameter in module.parameters():
                noise = torch.randn(parameter.shape, generator=generator).to(machine.device)
                parameter.data *= 1 + ROUNDING * noise
            generator.manual_seed(1)
        curves[name] = []
        for _ in range(steps):
            loss = module.training_step({"points": _hinged_slabs(4, 128, generator).to(machine.device)}, 0)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            curves[name].append(loss.item())
    return curves


def _hinged_slabs(batch: int, num_points: int, generator: torch.Generator) -> Tensor:
    """[B, N, 3] two slabs that share an edge, open by 10 to 100 degrees and turned about z at random."""
    across, along, thick = torch.rand(3, batch, num_points, generator=generator)
    opening = torch.deg2rad(10 + 90 * torch.rand(batch, 1, generator=generator))
    angle = torch.where(torch.arange(num_points) % 2 == 0, 0.0, opening)
    points = torch.stack(
        [
            along - 0.5,
            across * angle.cos() - 0.05 * thick * angle.sin(),
            across * angle.sin() + 0.05 * thick * angle.cos(),
        ],
        dim=-1,
    )
    turn = 2 * math.pi * torch.rand(batch, generator=generator)
    cos, sin, zero, one = turn.cos(), turn.sin(), torch.zeros(batch), torch.ones(batch)
    rotation = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).view(batch, 3, 3)
    return 0.6 * (points - points.mean(dim=1, keepdim=True)) @ rotation.transpose(1, 2)


def plot_curves(curves: dict[str, list[float]], path: Path) -> None:
    """Loss against step, one curve over the other, and their relative difference."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    fast, *others = curves
    left.plot(curves[fast], label=fast, linewidth=4, alpha=0.4)
    for number, name in enumerate(others, 1):
        left.plot(curves[name], label=name, linewidth=1, color=f"C{number}")
        difference = [abs(a - b) / a for a, b in zip(curves[fast], curves[name], strict=True)]
        right.semilogy(difference, label=f"{name} against {fast}", color=f"C{number}", linewidth=1)
    left.set(xlabel="step", ylabel="loss")
    right.set(xlabel="step", ylabel="relative difference of the loss")
    for axis in (left, right):
        axis.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, draw, and print the loss that each run reaches."""
    parser = argparse.ArgumentParser(
        prog="python -m articulate_ssl.benchmark.curves", description=__doc__.split("\n")[0]
    )
    parser.add_argument("plot", type=Path, help="where to draw the curves")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args(arguments)
    curves = training_curves(Machine(options.device, "32"), options.steps)
    plot_curves(curves, options.plot)
    for name, losses in curves.items():
        Console().print(f"{name}: mean loss of the last {LAST} steps {statistics.mean(losses[-LAST:]):.4f}")


if __name__ == "__main__":
    main()
