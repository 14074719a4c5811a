"""Networks and schedules small enough for a test, on the boxes of `synthetic`."""

from __future__ import annotations

import logging
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from lightning.pytorch import Trainer
from synthetic import write_synthetic_set

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.schedule import ScheduleOptions
from datamodules.articulated_data_module import ArticulatedDataModule

POINTS = 48
NETWORK = NetworkOptions(
    group_order=12,
    dims=[4, 8],
    radii=[0.25, 0.4],
    num_neighbors=8,
    num_kernel_points=13,
    num_centers=[32, 16],
    head_dim=8,
    shape_points=12,
)
# Not all of the synthetic set's 12 training clouds: a choice among them that reads a label would show in the weights.
DISCOVERY = DiscoveryOptions(
    clouds=6,
    split_clouds=6,
    points=POINTS,
    references=1,
    starts=2,
    jointed=1,
    rounds=1,
    edge_hinges=False,
    proposals=["random_cuts"],
    cycles=1,
    min_share=0.02,
)


def tiny_module(steps: int = 6, rigid_steps: int = 0, warmup_steps: int = 2, network=None, **options):
    """A module of tiny networks, the same for the same arguments."""
    torch.manual_seed(0)
    schedule = ScheduleOptions(
        steps=steps, rigid_steps=rigid_steps, warmup_steps=warmup_steps, learning_rate=1e-3, decay_every=2
    )
    options = {"num_parts": 2, "discovery": DISCOVERY, "schedule": schedule, "calibration_samples": 8} | options
    return ArticulatedPoseModule("laptop", network=replace(NETWORK, **(network or {})), **options)


def tiny_data(root: Path, **options) -> ArticulatedDataModule:
    """Batches of four clouds of the synthetic set under `root`."""
    options = {"num_points": POINTS, "batch_size": 4, "val_samples": 0} | options
    return ArticulatedDataModule("laptop", root=str(root), **options)


def quiet_trainer(folder: Path, **options) -> Trainer:
    """The real Trainer on the CPU, that prints nothing, and keeps nothing unless asked to."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    return Trainer(
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        **{"enable_checkpointing": False} | options,
    )


def fit(module: ArticulatedPoseModule, root: Path, steps: int, checkpoint: Path | None = None, **options) -> Trainer:
    """Train to a step."""
    trainer = quiet_trainer(root, max_steps=steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(module, tiny_data(root, **options), ckpt_path=checkpoint)
    return trainer


def warmed_up(root: Path) -> ArticulatedPoseModule:
    """A module after its warm-up on a synthetic set, which is written under `root`."""
    write_synthetic_set(root)
    module = tiny_module()
    fit(module, root, 3)
    return module
