r"""`make bench-gpu`: training and prediction at the paper's size on GPUs, one or many, by Lightning's trainer.

A category's configuration and `configs/profiles/gpu.yaml`, the paper's objective, clouds made in memory: neither a data
set nor a renderer. A step is timed from the end of the one before; the schedule is as long as the run, so that all its
phases are in it. All GPUs of a machine take part; on several machines torchrun or srun starts the processes:

    python -m articulate_ssl.benchmark.paper_size
    torchrun --nnodes 2 --nproc-per-node 8 --rdzv-backend c10d --rdzv-endpoint HOST:29500 \
        -m articulate_ssl.benchmark.paper_size --nodes 2
    srun --nodes 2 --ntasks-per-node 8 --gpus-per-node 8 python -m articulate_ssl.benchmark.paper_size --nodes 2
"""

from __future__ import annotations

import argparse
import json
import logging
import statistics
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
import yaml
from lightning.pytorch import Callback, LightningDataModule, Trainer
from rich.console import Console
from torch.utils.data import DataLoader

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.result import Result
from articulate_ssl.benchmark.table import print_table
from articulate_ssl.benchmark.whole_network import inference
from articulate_ssl.benchmark.workload import random_clouds
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.ranks import world
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.schedule import ScheduleOptions

CONFIGS = Path(__file__).parents[2] / "configs"
NO_GPU = 2  # exit code, as of all bad input
WARM_UP = 10  # steps before those that count: kernels are chosen and memory is taken in the first ones
LONG = 10_000  # steps of a whole training
# On a CPU a step at the paper's size takes half a minute, so there the command can only be tried, at a size that tells
# nothing about speed.
TRIAL_POINTS, TRIAL_NETWORK = (
    32,
    NetworkOptions(
        group_order=12,
        dims=[4, 6],
        radii=[0.2, 0.3],
        num_neighbors=8,
        num_kernel_points=13,
        head_dim=8,
        shape_points=16,
    ),
)


class Clouds(LightningDataModule):
    """Batches of clouds in memory, each cloud once; Lightning shares them out among the processes.

    Args:
        num_points: Of a cloud.
        batch_size: Of a process.
        batches: Of all processes together.
    """

    def __init__(self, num_points: int, batch_size: int, batches: int) -> None:
        super().__init__()
        self.save_hyperparameters()

    def train_dataloader(self) -> DataLoader:
        """{"points": [B, N, 3]}."""
        sizes = self.hparams
        clouds = random_clouds(Machine("cpu", "32"), sizes.batch_size * sizes.batches, sizes.num_points)
        return DataLoader([{"points": cloud} for cloud in clouds], sizes.batch_size)


class StopWatch(Callback):
    """Measures training.

    Attributes:
        seconds: Of every step, with all that lies between it and the one before.
        peak_bytes: Largest memory of this process beyond the weights.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine, self.seconds, self.peak_bytes = machine, [], 0.0

    def on_train_start(self, *_) -> None:
        """Of memory, the weights are held; time begins."""
        self._held, self._last = self.machine.forget_peak(), self.machine.time()

    def on_train_batch_end(self, *_) -> None:
        """A step is done."""
        now = self.machine.time()
        self.seconds.append(now - self._last)
        self._last = now

    def on_train_end(self, *_) -> None:
        """All are."""
        self.peak_bytes = self.machine.peak() - self._held


@flush_denormals()  # as the command line does
def main(arguments: Sequence[str] | None = None) -> int:
    """Train, predict, print a table; return the exit code."""
    options = _parse(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        print(
            "paper_size: no GPU here; run `make bench-gpu`, or `python -m articulate_ssl.benchmark.paper_size`, on a "
            "machine with one (`--device cpu --steps 2` only tries the command, at a tiny size)",
            file=sys.stderr,
        )
        return NO_GPU
    torch.set_float32_matmul_precision("high")  # as `lightning fit` does
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for message in (".*does not have many workers.*", ".*isinstance.treespec, LeafSpec.*", ".*no `val_dataloader`.*"):
        warnings.filterwarnings("ignore", message)
    profile = yaml.safe_load((CONFIGS / "profiles" / "gpu.yaml").read_text())["trainer"]
    if options.device == "cpu":
        profile |= {"accelerator": "cpu"}
    machine = Machine(options.device, "bf16" if "bf16" in profile["precision"] else "32")
    module, results = _train(machine, profile | {"devices": options.devices, "num_nodes": options.nodes}, options)
    if world()[1] == 0:
        results += inference(machine, module.to(machine.device).eval())
        console = Console(width=110)
        print_table(console, machine, results)
        if not machine.on_gpu:
            console.print("A trial at a tiny size: it says nothing about the paper's.", style="yellow")
        if options.json:
            numbers = {result.key: result.median for result in results if result.key}
            about = {"device": machine.name, "precision": machine.precision, "torch": torch.__version__}
            about["size"] = "paper" if machine.on_gpu else "trial"
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(about | numbers, indent=2) + "\n")
    return 0


def _train(
    machine: Machine, trainer_options: dict, options: argparse.Namespace
) -> tuple[ArticulatedPoseModule, list[Result]]:
    """Train some steps of the category's configuration; the module, and what this process measured."""
    config = yaml.safe_load((CONFIGS / f"{options.category}.yaml").read_text())
    data, sizes = config["data"], config["model"]
    points, network = (data["num_points"], NetworkOptions()) if machine.on_gpu else (TRIAL_POINTS, TRIAL_NETWORK)
    steps = WARM_UP + options.steps
    torch.manual_seed(0)
    schedule = ScheduleOptions(steps=steps)
    module = ArticulatedPoseModule(
        options.category, recipe="paper", network=network, schedule=schedule, calibration_samples=0, **sizes
    )
    watch = StopWatch(machine)
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    trainer = Trainer(max_steps=steps, callbacks=[watch], **quiet, **trainer_options)
    batch = data["batch_size"]
    trainer.fit(module, Clouds(points, batch, steps * trainer.world_size))
    seconds = watch.seconds[WARM_UP:]
    return module, [
        Result("processes", "processes", [float(trainer.world_size)]),
        Result("train_step_s_paper", f"training step, batch {batch} in each process", seconds, "s"),
        # The mean, since the schedule's phases differ.
        Result("train_minutes_10000_steps", f"  {LONG:,} steps", [LONG * statistics.mean(seconds) / 60], "min"),
        Result("train_gb", "  peak memory of a process", [watch.peak_bytes / 1e9], "GB"),
    ]


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m articulate_ssl.benchmark.paper_size", description=__doc__.splitlines()[0]
    )
    categories = sorted(path.stem for path in CONFIGS.glob("*.yaml"))
    parser.add_argument("--category", default="laptop", choices=categories, help="whose configuration is trained")
    parser.add_argument("--steps", type=int, default=60, help=f"that are timed, after {WARM_UP} others")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--devices", default="auto", help="processes on each machine; default: one for each GPU")
    parser.add_argument("--nodes", type=int, default=1, help="machines that torchrun or srun has started this on")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    options = parser.parse_args(arguments)
    if options.steps < 1:
        parser.error(f"--steps {options.steps}: at least one step must be timed")
    return options


if __name__ == "__main__":
    sys.exit(main())
