"""Training step and inference of the whole network."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path

import yaml

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.result import Result
from articulate_ssl.benchmark.training_step import build_module, training_step
from articulate_ssl.benchmark.workload import random_clouds
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.module import ArticulatedPoseModule

CPU_PROFILE = Path(__file__).parents[2] / "configs" / "profiles" / "cpu.yaml"
TEST_BATCH = 8  # of the configurations: what `lightning test` holds in memory at a time


def whole_network(machine: Machine) -> list[Result]:
    """Training step and inference of the whole network, at paper size and at that of the cpu profile."""
    results = [_training_step_of_cpu_profile(machine)]
    results += inference(machine, build_module(machine, NetworkOptions()).eval())
    for name in ("separable", "directions"):
        results += _cheaper_inference_of_one_cloud(machine, name)
    return [*results, *_training_step_at_paper_size(machine)]


def _training_step_of_cpu_profile(machine: Machine) -> Result:
    profile = yaml.safe_load(CPU_PROFILE.read_text())
    data = profile["data"]
    step = training_step(machine, NetworkOptions(**profile["model"]["network"]), data["batch_size"], data["num_points"])
    step()
    label = f"training step, cpu profile, batch {data['batch_size']}"
    return Result("train_step_s_cpu_profile", label, [machine.seconds(step) for _ in range(7)], "s")


def inference(machine: Machine, module: ArticulatedPoseModule) -> list[Result]:
    """Prediction without registration, of one cloud and of 64."""
    return [*_inference_of_one_cloud(machine, module), *_inference_of_many_clouds(machine, module)]


def _predict(machine: Machine, module: ArticulatedPoseModule, clouds: int) -> Callable[[], None]:
    points = random_clouds(machine, clouds, module.num_points)
    batches = points.split(clouds if machine.on_gpu else TEST_BATCH)

    def run() -> None:
        for batch in batches:
            module.predict_points(batch, refine=False)

    return run


def _inference_of_one_cloud(machine: Machine, module: ArticulatedPoseModule) -> list[Result]:
    run, recorded = _predict(machine, module, 1), 3 if machine.on_gpu else 1

    def first_runs() -> None:
        # A GPU records what it does (`ops/replay.py`): memory is taken then, and no longer when it is replayed.
        for _ in range(recorded):
            run()

    memory = machine.peak_bytes(first_runs) / 1e9
    rates = [1 / machine.seconds(run) for _ in range(20 if machine.on_gpu else 3)]
    return [
        Result("inference_clouds_per_s_b1", "inference, paper size, batch 1", rates, "/s"),
        Result("inference_gb_b1", "  peak memory", [memory], "GB"),
    ]


def _cheaper_inference_of_one_cloud(machine: Machine, name: str) -> list[Result]:
    module = build_module(machine, NetworkOptions(**{name: True})).eval()
    rate, memory = _inference_of_one_cloud(machine, module)
    return [
        Result(f"{rate.key}_{name}", f"  {name}", rate.values, "/s"),
        Result(None, f"  {name}, peak memory", memory.values, "GB"),
    ]


def _inference_of_many_clouds(machine: Machine, module: ArticulatedPoseModule) -> list[Result]:
    run = _predict(machine, module, 64)
    if machine.on_gpu:
        run()
    rates = [64 / machine.seconds(run) for _ in range(5 if machine.on_gpu else 1)]
    results = [Result("inference_clouds_per_s_b64", "inference, paper size, 64 clouds", rates, "/s")]
    if machine.on_gpu:
        results.append(Result("inference_gb_b64", "  peak memory", [machine.peak_bytes(run) / 1e9], "GB"))
    return results


def _training_step_at_paper_size(machine: Machine) -> list[Result]:
    step = training_step(machine, NetworkOptions(), 8, 512)
    if machine.on_gpu:
        step()
    seconds = [machine.seconds(step) for _ in range(10 if machine.on_gpu else 1)]
    return [
        Result("train_step_s_paper", "training step, paper size, batch 8", seconds, "s"),
        Result(None, "  10,000 steps", [10_000 * statistics.median(seconds) / 60], "min"),
    ]
