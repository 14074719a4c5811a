"""Speed of data generation, as `make bench` prints it: whole shards, from the procedural source to files on disk."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from render.execution import run_tasks
from render.generate import choose_renderer
from render.object_set import split_instances
from render.shard_task import SetOptions, plan_shards

_OPTIONS = SetOptions(
    category="laptop",
    source="procedural",
    root=None,
    view="complete",
    protocol=None,
    seed=0,
    train_instances=8,
    test_instances=0,
    states=100,
    rotations=1,
    views=10,
    resolution=256,
    points=4096,
    noise_std=0.0,
    renderer=None,
)


def complete_clouds_per_s(workers: int = 2) -> float:
    """Complete laptop clouds of 4096 points per second."""
    return _samples_per_s(_OPTIONS, workers)


def partial_frames_per_s(workers: int = 2) -> float:
    """Partial laptop clouds of 4096 points, from depth images of 256 x 256 pixels, per second."""
    partial = replace(_OPTIONS, view="partial", protocol="honest", states=25, renderer=choose_renderer("auto"))
    return _samples_per_s(partial, workers)


def _samples_per_s(options: SetOptions, workers: int) -> float:
    """Samples per second while every worker is busy: the time in which workers start and load libraries is left out."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "train").mkdir()
        instances = split_instances(options, options.open().instance_ids())
        tasks = plan_shards(options, Path(folder), "train", instances["train"])
        finished = [(time.perf_counter(), result.samples) for result in run_tasks(tasks, workers)]
    # Counted from the moment when the last worker has delivered its first shard.
    start, _ = finished[workers - 1]
    return sum(samples for _, samples in finished[workers:]) / (finished[-1][0] - start)
