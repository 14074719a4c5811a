"""How time and memory grow with points, group, parts and batch."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.training_step import training_step
from articulate_ssl.benchmark.workload import forward_backward, random_clouds
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.options import NetworkOptions

BATCH = 4
SMALL = {"dims": (16, 32, 64), "num_neighbors": 32}


def growth(machine: Machine) -> dict[str, tuple[list[int], list[float], list[float]]]:
    """Seconds and bytes of forward + backward against points, group, parts and batch, all else fixed."""

    def backbone(group: int = 12, batch: int = BATCH, num_points: int = 256) -> Callable[[], None]:
        module = EquivariantBackbone(group, **SMALL).to(machine.device)
        points = random_clouds(machine, batch, num_points)
        return forward_backward(lambda: module(points))

    def network(parts: int) -> Callable[[], None]:
        options = NetworkOptions(group_order=12, dims=list(SMALL["dims"]), num_neighbors=32, head_dim=64)
        return training_step(machine, options, BATCH, 256, parts)

    sweeps: dict[str, tuple[Sequence[int], Callable[[int], Callable]]] = {
        "points": ((256, 512, 1024, 2048), lambda n: backbone(num_points=n)),
        "group": ((12, 24, 60), lambda g: backbone(group=g)),
        "parts": ((2, 4, 8), network),
        "batch": ((4, 8, 16, 32), lambda b: backbone(batch=b)),
    }
    measured = {}
    for name, (sizes, make) in sweeps.items():
        runs = [make(size) for size in sizes]
        for run in runs:
            run()
        seconds = [min(machine.seconds(run) for _ in range(3)) for run in runs]
        measured[name] = (list(sizes), seconds, [machine.peak_bytes(run) for run in runs])
    return measured


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Slope of the cost in a log-log plot (least squares): 1 is linear growth."""
    x, y = [math.log(s) for s in sizes], [math.log(max(c, 1.0e-9)) for c in costs]
    return statistics.linear_regression(x, y).slope


def plot_growth(measured: dict[str, tuple[list[int], list[float], list[float]]], path: Path) -> None:
    """Time and memory against each size, with fitted exponents."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.5), layout="constrained")
    axes = figure.subplots(2, len(measured))
    for column, (name, (sizes, seconds, memory)) in enumerate(measured.items()):
        for row, (costs, unit) in enumerate(((seconds, "s"), ([m / 1e6 for m in memory], "MB"))):
            axis = axes[row, column]
            axis.loglog(sizes, costs, "o-", label=f"exponent {exponent(sizes, costs):.2f}")
            axis.loglog(sizes, [costs[0] * s / sizes[0] for s in sizes], ":", color="grey", label="linear")
            axis.set_xticks(sizes, [str(s) for s in sizes])
            axis.minorticks_off()
            axis.set_xlabel(name)
            axis.set_ylabel(f"forward + backward [{unit}]")
            axis.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
