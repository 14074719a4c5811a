"""`make bench`: how fast the fast operators are against their readable twins, and how cost grows.

Every ratio is measured in one run, twin and fast operator in turn, so that load on the machine hits both. The twins are
those of `ops.reference`; they compute as the original implementation does, with correlation weights for every
neighbour, kernel point and group element. Needs neither a renderer nor a data set; runs on any device that PyTorch
knows:

    python -m articulate_ssl.benchmark --device cuda
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import math
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
import yaml
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articulate_ssl.module import ArticulatedPoseModule
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.ops import chamfer, reference
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.direction_convolution import direction_convolution
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.kernel_points import symmetric_kernel_points
from articulate_ssl.ops.neighborhood import Neighborhood, build_neighborhood
from articulate_ssl.ops.separable_group_convolution import separable_group_convolution
from articulate_ssl.options import NetworkOptions
from datamodules.benchmark import loader_samples_per_s

CPU_PROFILE = Path(__file__).parents[1] / "configs" / "profiles" / "cpu.yaml"
EXTENT = 0.6  # side of the cube that random clouds fill: balls hold about as many points as on a real object's surface
GROWTH_BATCH = 4
TEST_BATCH = 8  # of the configurations: what `lightning test` holds in memory at a time
# A program of its own: the method does not import the renderer, and runs where there is none.
GENERATION = """
import json
from render.benchmark import complete_clouds_per_s, partial_frames_per_s
print(json.dumps({f.__name__: f() for f in (partial_frames_per_s, complete_clouds_per_s)}))
"""
SMALL = {"dims": (16, 32, 64), "num_neighbors": 32}


@dataclass
class Result:
    """A measured number with its spread.

    Attributes:
        key: name in bench.json, or None for a row of the table only.
        label: row of the table.
        values: repetitions.
        unit: after the number.
    """

    key: str | None
    label: str
    values: list[float]
    unit: str = ""

    @property
    def median(self) -> float:
        """Median of the repetitions."""
        return statistics.median(self.values)


class Machine:
    """Clock, memory meter and precision of one device."""

    def __init__(self, device: str, precision: str) -> None:
        self.device = torch.device(device)
        self.precision = precision

    @property
    def name(self) -> str:
        """The device in words."""
        if self.device.type == "cuda":
            return torch.cuda.get_device_name(self.device)
        model = platform.processor() or platform.machine()
        cpuinfo = Path("/proc/cpuinfo")
        if cpuinfo.exists():
            names = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
            model = names[0] if names else model
        return f"{model}, {torch.get_num_threads()} threads"

    def autocast(self):
        """Mixed precision where it was asked for."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.precision == "bf16" else nullcontext()

    def seconds(self, function: Callable[[], object]) -> float:
        """Wall-clock seconds of one call."""
        self._synchronize()
        start = time.perf_counter()
        function()
        self._synchronize()
        return time.perf_counter() - start

    def peak_bytes(self, function: Callable[[], object]) -> float:
        """Largest memory during one call, beyond what was held before it (Linux or CUDA)."""
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
            function()
            return torch.cuda.max_memory_allocated() - before
        ctypes.CDLL(None).malloc_trim(0)  # memory that malloc keeps for later would hide what the call needs
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
        before = _status_bytes("VmRSS")
        function()
        return _status_bytes("VmHWM") - before

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def _status_bytes(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * float(line.split()[1]) for line in lines if line.startswith(field + ":"))


def _clouds(machine: Machine, batch: int, num_points: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return (EXTENT * torch.rand(batch, num_points, 3, generator=generator)).to(machine.device)


def _forward_backward(function: Callable[[], Tensor]) -> Callable[[], None]:
    """Backward from a gradient made once, so that no loss is measured with the function."""
    with torch.no_grad():
        direction = torch.randn_like(function())

    def run() -> None:
        out = function()
        out.backward(direction.to(out.dtype))

    return run


def _ratio(machine: Machine, twin: Callable, fast: Callable, repeats: int) -> tuple[list[float], list[float]]:
    """Ratios twin / fast of interleaved calls, and the seconds of the fast one; one call of the fast one warms up."""
    machine.seconds(fast)
    pairs = [(machine.seconds(twin), machine.seconds(fast)) for _ in range(repeats)]
    return [a / b for a, b in pairs], [b for _, b in pairs]


class OriginalBackbone(nn.Module):
    """The twin of `EquivariantBackbone`: the same parameters, every layer as the original runs it.

    The original's articulated backbone calls its pose-aware convolution with identity poses.
    """

    def __init__(self, backbone: EquivariantBackbone) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, points: Tensor) -> Tensor:
        """Features [B, N, G, C] of points [B, N, 3]."""
        group = self.backbone.group
        kernel = symmetric_kernel_points(group, len(self.backbone.kernel_points))
        poses = torch.eye(4, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 4, 4)
        features = points.new_ones(*points.shape[:2], len(group), 1)
        for block, radius in zip(self.backbone.blocks, self.backbone.radii, strict=True):
            features = reference.pose_aware_convolution(
                features, points, poses, block.weight, group, kernel, radius, self.backbone.num_neighbors
            )
            features = leaky_relu(block.norm(features), negative_slope=0.01)
        return features


def operators(machine: Machine) -> list[Result]:
    """Convolution layer 64 -> 128, backbone and Chamfer distance against their twins, at paper size."""
    results = []
    torch.manual_seed(0)
    backbone = EquivariantBackbone().to(machine.device)
    points = _clouds(machine, 1, 512)
    block, kernel = backbone.blocks[1], backbone.kernel_points
    neighborhood = build_neighborhood(points, backbone.radii[1], kernel, backbone.num_neighbors)
    features = torch.randn(1, 512, 60, 64, device=machine.device, requires_grad=True)
    arguments = (features, neighborhood, block.weight, block.permutation)

    def fast() -> Tensor:
        with machine.autocast():
            return group_convolution(*arguments)

    def twin() -> Tensor:
        return reference.group_convolution(*arguments)

    def without_gradient(function: Callable[[], Tensor]) -> Callable[[], None]:
        def run() -> None:
            with torch.no_grad():
                function()

        return run

    ratios, seconds = _ratio(machine, without_gradient(twin), without_gradient(fast), 5)
    results.append(Result("conv_fwd_ratio", "convolution 64 -> 128, forward, twin / ours", ratios, "x"))
    ratios, seconds = _ratio(machine, _forward_backward(twin), _forward_backward(fast), 5)
    results.append(Result("conv_fwd_bwd_ratio", "convolution 64 -> 128, forward + backward", ratios, "x"))
    results.append(Result(None, "  ours", seconds, "s"))

    results += cheaper_backbones(machine, points, features.detach(), neighborhood)

    original = OriginalBackbone(backbone)

    def fast_backbone() -> Tensor:
        with machine.autocast():
            return backbone(points)

    with torch.no_grad():
        error = (fast_backbone() - original(points)).norm() / original(points).norm()
    results.append(Result(None, f"backbone, relative error ({machine.precision})", [error.item()]))
    runs = _forward_backward(lambda: original(points)), _forward_backward(fast_backbone)
    memory = [machine.peak_bytes(run) for run in reversed(runs)]
    ratios, seconds = _ratio(machine, *runs, 3)
    results.append(Result("backbone_fwd_bwd_ratio", "backbone 1-64-128-512, forward + backward", ratios, "x"))
    results.append(Result(None, "  ours", seconds, "s"))
    results.append(Result("backbone_memory_ratio", "backbone, peak memory", [memory[1] / memory[0]], "x"))
    results.append(Result(None, "  ours", [memory[0] / 1e9], "GB"))
    results += ceiling(machine, statistics.median(seconds))

    x, y = (torch.rand(8, 1024, 3, device=machine.device, requires_grad=True) for _ in range(2))
    ratios, seconds = _ratio(
        machine,
        _forward_backward(lambda: reference.chamfer(x, y)),
        _forward_backward(lambda: chamfer.chamfer(x, y)),
        5,
    )
    results.append(Result("chamfer_fwd_bwd_ratio", "Chamfer 8 x 1024 x 1024, forward + backward", ratios, "x"))
    return results


def cheaper_backbones(machine: Machine, points: Tensor, features: Tensor, neighborhood: Neighborhood) -> list[Result]:
    """Layers 64 -> 128 of the cheaper kinds against their twins, and backbones of such layers."""
    kinds = {
        "separable": (separable_group_convolution, reference.separable_group_convolution, "permutation"),
        "directions": (direction_convolution, reference.direction_convolution, "orbit"),
    }
    results = []
    for name, (function, twin, table) in kinds.items():
        backbone = EquivariantBackbone(**{name: True}).to(machine.device)
        block = backbone.blocks[1]
        indexed = features[:, :, : len(getattr(block, table))].requires_grad_()  # by group elements or directions
        arguments = (indexed, neighborhood, block.spatial, block.mixing, getattr(block, table))

        def layer(function: Callable = function, arguments: tuple = arguments) -> Tensor:
            with machine.autocast():
                return function(*arguments)

        def forward(backbone: EquivariantBackbone = backbone) -> Tensor:
            with machine.autocast():
                return backbone(points)

        slow = _forward_backward(lambda twin=twin, arguments=arguments: twin(*arguments))
        ratios, seconds = _ratio(machine, slow, _forward_backward(layer), 5)
        run = _forward_backward(forward)
        memory = machine.peak_bytes(run)
        whole = [machine.seconds(run) for _ in range(3)]
        with torch.no_grad():
            once = [machine.seconds(forward) for _ in range(3)]
        results += [
            Result(None, f"{name}: convolution 64 -> 128, forward + backward", ratios, "x"),
            Result(None, "  ours", seconds, "s"),
            Result(None, f"{name}: backbone, forward", once, "s"),
            Result(None, "  forward + backward", whole, "s"),
            Result(None, "  peak memory", [memory / 1e9], "GB"),
        ]
    return results


def ceiling(machine: Machine, backbone_seconds: float) -> list[Result]:
    """How close the backbone's forward + backward comes to the machine's measured rate of matrix products."""
    size = 8192 if machine.device.type == "cuda" else 2048
    dtype = torch.bfloat16 if machine.precision == "bf16" else torch.float32
    a = torch.randn(size, size, device=machine.device, dtype=dtype)
    machine.seconds(lambda: a @ a)
    rate = 2 * size**3 / min(machine.seconds(lambda: a @ a) for _ in range(5))
    positions, kernel_points, neighbors = 512 * 60, 24, 64
    products = sum(
        positions * kernel_points * c_in * (neighbors * (c_in > 1) + c_out)
        for c_in, c_out in ((1, 64), (64, 128), (128, 512))
    )
    floor = 3 * 2 * products / rate  # forward, and twice as much backward
    return [
        Result(None, f"matrix products {size}^3 ({dtype})", [rate / 1e12], "TFLOP/s"),
        Result(None, "backbone, share of that rate", [floor / backbone_seconds]),
    ]


def growth(machine: Machine) -> dict[str, tuple[list[int], list[float], list[float]]]:
    """Seconds and bytes of forward + backward against points, group, parts and batch, all else fixed."""

    def backbone(group: int = 12, batch: int = GROWTH_BATCH, num_points: int = 256) -> Callable[[], None]:
        module = EquivariantBackbone(group, **SMALL).to(machine.device)
        points = _clouds(machine, batch, num_points)
        return _forward_backward(lambda: module(points))

    def network(parts: int) -> Callable[[], None]:
        options = NetworkOptions(group_order=12, dims=list(SMALL["dims"]), num_neighbors=32, head_dim=64)
        return _training_step(machine, options, GROWTH_BATCH, 256, parts)

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


def build_module(machine: Machine, options: NetworkOptions, parts: int = 2) -> ArticulatedPoseModule:
    """A module under the paper's objective, without a trainer."""
    torch.manual_seed(0)
    module = ArticulatedPoseModule("benchmark", parts, recipe="paper", network=options)
    module.log_dict = lambda *args, **kwargs: None  # there is no trainer to log to
    return module.to(machine.device)


def _training_step(
    machine: Machine, options: NetworkOptions, batch: int, num_points: int, parts: int = 2
) -> Callable[[], None]:
    """Forward, loss of the paper's objective, backward and optimiser step."""
    module = build_module(machine, options, parts)
    optimizer = module.configure_optimizers()["optimizer"]
    clouds = {"points": _clouds(machine, batch, num_points)}

    def step() -> None:
        optimizer.zero_grad()
        with machine.autocast():
            loss = module.training_step(clouds, 0)
        loss.backward()
        optimizer.step()

    return step


def whole_network(machine: Machine) -> list[Result]:
    """Training step and inference of the whole network, at paper size and at that of the cpu profile."""
    on_gpu = machine.device.type == "cuda"
    profile = yaml.safe_load(CPU_PROFILE.read_text())
    data = profile["data"]
    step = _training_step(
        machine, NetworkOptions(**profile["model"]["network"]), data["batch_size"], data["num_points"]
    )
    step()
    label = f"training step, cpu profile, batch {data['batch_size']}"
    results = [Result("train_step_s_cpu_profile", label, [machine.seconds(step) for _ in range(7)], "s")]

    module = build_module(machine, NetworkOptions()).eval()

    def infer(clouds: int, module: ArticulatedPoseModule = module) -> Callable[[], None]:
        points = _clouds(machine, clouds, 512)
        batches = points.split(clouds if on_gpu else TEST_BATCH)

        def run() -> None:
            with machine.autocast():
                for batch in batches:
                    module.predict_points(batch, refine=False)

        return run

    one, many = infer(1), infer(64)
    one()
    seconds = [machine.seconds(one) for _ in range(20 if on_gpu else 3)]
    results.append(
        Result("inference_clouds_per_s_b1", "inference, paper size, batch 1", [1 / s for s in seconds], "/s")
    )
    results.append(Result(None, "  peak memory", [machine.peak_bytes(one) / 1e9], "GB"))
    for name in ("separable", "directions"):
        cheaper = infer(1, build_module(machine, NetworkOptions(**{name: True})).eval())
        cheaper()
        seconds = [machine.seconds(cheaper) for _ in range(20 if on_gpu else 5)]
        results.append(Result(f"inference_clouds_per_s_b1_{name}", f"  {name}", [1 / s for s in seconds], "/s"))
        results.append(Result(None, f"  {name}, peak memory", [machine.peak_bytes(cheaper) / 1e9], "GB"))
    if on_gpu:
        many()
    seconds = [machine.seconds(many) for _ in range(5 if on_gpu else 1)]
    rates = [64 / s for s in seconds]
    results.append(Result("inference_clouds_per_s_b64", "inference, paper size, 64 clouds", rates, "/s"))
    step = _training_step(machine, NetworkOptions(), 8, 512)
    if on_gpu:
        step()
    seconds = [machine.seconds(step) for _ in range(10 if on_gpu else 1)]
    results.append(Result("train_step_s_paper", "training step, paper size, batch 8", seconds, "s"))
    results.append(Result(None, "  10,000 steps", [10_000 * statistics.median(seconds) / 60], "min"))
    return results


def data_pipeline(console: Console) -> list[Result]:
    """Speed of generation (a separate program) and of the training loader."""
    loader = Result("loader_samples_per_s", "training loader", [loader_samples_per_s()], "/s")
    finished = subprocess.run([sys.executable, "-c", GENERATION], capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        reason = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        console.print(f"generation not measured, the renderer does not run here: {reason}", style="yellow")
        return [loader]
    rendered = json.loads(finished.stdout.strip().splitlines()[-1])
    return [loader, *(Result(key, key.replace("_", " "), [value]) for key, value in rendered.items())]


def print_table(console: Console, machine: Machine, results: Sequence[Result]) -> None:
    """Median and spread of every result."""
    title = f"{machine.name}, {machine.precision}, torch {torch.__version__}"
    table = Table("", "median", "lowest", "highest", "runs", title=title)
    for result in results:
        numbers = [f"{v:.3g} {result.unit}" for v in (result.median, min(result.values), max(result.values))]
        table.add_row(result.label, *numbers, str(len(result.values)))
    console.print(table)


@flush_denormals()  # as the command line does
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print one table, write bench.json and the plot."""
    parser = argparse.ArgumentParser(prog="python -m articulate_ssl.benchmark", description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--precision", choices=("32", "bf16"), help="default: bf16 on a GPU, 32 on a CPU")
    parser.add_argument("--output", type=Path, default=Path("build"), help="folder of bench.json and bench.png")
    parser.add_argument("--plot", type=Path, help="a second place for the plot, for the documentation")
    options = parser.parse_args(arguments)
    machine = Machine(options.device, options.precision or ("bf16" if options.device.startswith("cuda") else "32"))
    console = Console(width=110)
    options.output.mkdir(parents=True, exist_ok=True)
    results: list[Result] = []

    def keep(more: Sequence[Result]) -> None:
        # Written after every part: a later part that fails loses nothing.
        results.extend(more)
        numbers = {result.key: result.median for result in results if result.key}
        (options.output / "bench.json").write_text(json.dumps(numbers | {"device": machine.name}, indent=2) + "\n")

    keep(operators(machine))
    measured = growth(machine)
    for path in filter(None, (options.output / "bench.png", options.plot)):
        plot_growth(measured, path)
    for name, (sizes, seconds, memory) in measured.items():
        keep([Result(f"exponent_{name}", f"growth of time with {name}, exponent", [exponent(sizes, seconds)])])
        keep([Result(None, "  growth of memory", [exponent(sizes, memory)])])
    keep(data_pipeline(console))
    keep(whole_network(machine))
    print_table(console, machine, results)


if __name__ == "__main__":
    main()
