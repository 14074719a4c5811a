"""The fast operators against their readable twins, at paper size."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.benchmark.ceiling import ceiling
from articulate_ssl.benchmark.cheaper_backbones import cheaper_backbones
from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.original_backbone import OriginalBackbone
from articulate_ssl.benchmark.result import Result
from articulate_ssl.benchmark.workload import forward_backward, random_clouds, ratios_and_seconds
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.ops import chamfer, reference
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.neighborhood import Neighborhood, build_neighborhood
from articulate_ssl.ops.spin_images import spin_images


def operators(machine: Machine) -> list[Result]:
    """Convolution layer 64 -> 128, backbone, Chamfer distance and spin images against their twins, at paper size."""
    torch.manual_seed(0)
    backbone = EquivariantBackbone().to(machine.device)
    points = random_clouds(machine, 1, 512)
    neighborhood = build_neighborhood(points, backbone.radii[1], backbone.kernel_points, backbone.num_neighbors)
    features = torch.randn(1, 512, 60, 64, device=machine.device, requires_grad=True)
    return [
        *_convolution(machine, backbone, features, neighborhood),
        *cheaper_backbones(machine, points, features.detach(), neighborhood),
        *_backbone(machine, backbone, points),
        *_chamfer(machine),
        *_spin_images(machine),
    ]


def _convolution(
    machine: Machine, backbone: EquivariantBackbone, features: Tensor, neighborhood: Neighborhood
) -> list[Result]:
    block = backbone.blocks[1]
    arguments = (features, neighborhood, block.weight, block.permutation)

    def fast() -> Tensor:
        with machine.autocast():
            return group_convolution(*arguments)

    def twin() -> Tensor:
        return reference.group_convolution(*arguments)

    forward, _ = ratios_and_seconds(machine, _without_gradient(twin), _without_gradient(fast), 5)
    both, seconds = ratios_and_seconds(machine, forward_backward(twin), forward_backward(fast), 5)
    return [
        Result("conv_fwd_ratio", "convolution 64 -> 128, forward, twin / ours", forward, "x"),
        Result("conv_fwd_bwd_ratio", "convolution 64 -> 128, forward + backward", both, "x"),
        Result(None, "  ours", seconds, "s"),
    ]


def _without_gradient(function: Callable[[], Tensor]) -> Callable[[], None]:
    def run() -> None:
        with torch.no_grad():
            function()

    return run


def _backbone(machine: Machine, backbone: EquivariantBackbone, points: Tensor) -> list[Result]:
    original = OriginalBackbone(backbone)

    def fast() -> Tensor:
        with machine.autocast():
            return backbone(points)

    with torch.no_grad():
        error = (fast() - original(points)).norm() / original(points).norm()
    runs = forward_backward(lambda: original(points)), forward_backward(fast)
    memory = [machine.peak_bytes(run) for run in reversed(runs)]
    ratios, seconds = ratios_and_seconds(machine, *runs, 3)
    return [
        Result(None, f"backbone, relative error ({machine.precision})", [error.item()]),
        Result("backbone_fwd_bwd_ratio", "backbone 1-64-128-512, forward + backward", ratios, "x"),
        Result(None, "  ours", seconds, "s"),
        Result("backbone_memory_ratio", "backbone, peak memory", [memory[1] / memory[0]], "x"),
        Result(None, "  ours", [memory[0] / 1e9], "GB"),
        *ceiling(machine, statistics.median(seconds)),
    ]


def _chamfer(machine: Machine) -> list[Result]:
    x, y = (torch.rand(8, 1024, 3, device=machine.device, requires_grad=True) for _ in range(2))
    ratios, _ = ratios_and_seconds(
        machine,
        forward_backward(lambda: reference.chamfer(x, y)),
        forward_backward(lambda: chamfer.chamfer(x, y)),
        5,
    )
    return [Result("chamfer_fwd_bwd_ratio", "Chamfer 8 x 1024 x 1024, forward + backward", ratios, "x")]


def _spin_images(machine: Machine) -> list[Result]:
    directions = torch.randn(8, 4096, 3, generator=torch.Generator().manual_seed(0))
    surface = (0.3 * functional.normalize(directions, dim=-1)).to(machine.device)
    twin, fast = (partial(images, surface[:, :1024], surface) for images in (reference.spin_images, spin_images))
    ratios, seconds = ratios_and_seconds(machine, twin, fast, 5)
    return [
        Result("spin_images_ratio", "spin images of 1024 points, twin / ours", ratios, "x"),
        Result(None, "  ours, a cloud", [some / len(surface) for some in seconds], "s"),
    ]
