"""A run that can be packed, made in seconds: a tiny checkpoint and a synthetic set under the real configuration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml
from synthetic import write_synthetic_set
from tiny import POINTS, fit, tiny_module

from articulate_ssl.metrics.statistics import summarize
from articulate_ssl.pretrained import check
from articulate_ssl.pretrained.pack import PROFILES
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.shipped_weights import ShippedWeights
from articulate_ssl.training.weights_card import WeightsCard
from articulate_ssl.training.weights_file import write_weights
from datamodules.manifest import Manifest

ROOT = Path(__file__).parents[3]
DATA_SEED = 11


def merged_configuration(view: str) -> dict:
    """What Lightning makes of a category's file and the profiles."""
    merged: dict = {}
    for file in ("configs/laptop.yaml", *PROFILES[view]):
        _merge(merged, yaml.safe_load((ROOT / file).read_text()))
    return merged


def made_up_metrics(scale: float = 1.0, state: float = 3.0) -> dict:
    """Metrics of 16 clouds of 4 objects."""
    instance = torch.arange(4).repeat_interleave(4)
    values = torch.linspace(0.8, 1.2, 16, dtype=torch.float64) * scale

    def quantity(mean: float, single: str | None = None) -> dict:
        whole = summarize(values * mean, instance)
        return whole | ({single: [whole] * (2 if single == "parts" else 1)} if single else {})

    return {
        **{name: quantity(mean, "parts") for name, mean in (("r_err_deg", 4.0), ("flip_rate", 0.01), ("t_err", 0.03))},
        "above_30_rate": quantity(0.01, "parts"),
        "seg_miou": quantity(0.8 / scale**2, "parts"),
        **{name: quantity(m, "joints") for name, m in (("axis_err_deg", 2), ("pivot_err", 0.05), ("state_err", state))},
        "samples": 16,
        "instances": 4,
        "failures": 0,
        "category": "laptop",
    }


def trained(folder: Path) -> ArticulatedPoseModule:
    """A tiny module after three steps, that has been taught nothing."""
    write_synthetic_set(folder / "training")
    network = tiny_module()
    network.num_points = POINTS
    fit(network, folder / "training", 3)
    return network


def shipped_in(folder: Path, network: ArticulatedPoseModule, command: str) -> ShippedWeights:
    """Weights with a made-up card, whose data the command makes."""
    weights = ShippedWeights("laptop", "complete", folder / "laptop-complete.safetensors")
    write_weights(network, weights.file)
    WeightsCard(
        category="laptop",
        view="complete",
        part_names=["base", "lid"],
        data={"command": command, "seed": DATA_SEED},
        training={"command": "lightning fit", "commit": "abc"},
        metrics={name: value for name, value in made_up_metrics().items() if name != "category"},
        weaknesses=["none"],
        date="2026-01-02",
    ).save(folder / "laptop-complete.json")
    return weights


def stand_in_generator(monkeypatch: pytest.MonkeyPatch, seed: int = 12) -> list[list[str]]:
    """Lets a synthetic set stand in for whatever data a card's command asks for; returns the commands as they come."""
    commands = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        commands.append(command)
        write_synthetic_set(command[command.index("--out") + 1], seed=seed)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(check.subprocess, "run", run)
    return commands


def write_run(folder: Path) -> Path:
    """Data, checkpoint, configuration and metrics of laptops; returns the folder of the run."""
    data = write_synthetic_set(folder / "data")
    manifest = Manifest.load(data)
    options = {"category": "laptop", "view": "complete", "seed": DATA_SEED, "states": 4, "rotations": 2}
    options |= {"train_instances": 3, "test_instances": 2, "variant": None, "noise_std": 0.0}
    replace(manifest, options=options, seed=DATA_SEED).save(data)
    run = folder / "run" / "lightning_logs" / "version_1"
    run.mkdir(parents=True)
    fit(tiny_module(), folder / "data", 3).save_checkpoint(run / "last.ckpt")
    config = merged_configuration("complete")
    config["data"] |= {"root": str(folder / "data"), "source": "procedural", "view": "complete", "protocol": None}
    config["seed_everything"] = 0
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    (run / "metrics.json").write_text(json.dumps(made_up_metrics() | {"checkpoint": str(run / "last.ckpt")}))
    return folder / "run"


def _merge(into: dict, other: dict) -> None:
    for name, value in other.items():
        if isinstance(value, dict):
            _merge(into.setdefault(name, {}), value)
        else:
            into[name] = value
