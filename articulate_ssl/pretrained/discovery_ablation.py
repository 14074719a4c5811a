"""What part discovery finds without each of the things that it does: nothing is learnt after it, no network trained.

`ablation` leaves out what weights have learnt. Here discovery lacks one thing at a time: parts and joints are
found anew in the same training clouds, of a data seed of their own, and the category's shape as it was handed over is
searched in the same test clouds (`PoseEstimator.search`), calibrated and scored as ever.
"""

from __future__ import annotations

import json
import logging
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jsonargparse import ArgumentParser
from lightning import seed_everything

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.options import PROPOSALS
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.ops.progress import announced, shown
from articulate_ssl.pretrained.ablation import NOTHING
from articulate_ssl.pretrained.check import make_data
from articulate_ssl.pretrained.markdown_table import cells_of, table_of
from articulate_ssl.pretrained.study import WeightsStudy
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.weights_card import WeightsCard
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import set_folder

MINUTES = "minutes"  # of discovery
# Objects to discover in: of single clouds as many as discovery reads clouds; fewer where it knows which clouds are of
# one object, as each comes in ten states then.
_OBJECTS, _OBJECTS_IN_STATES = 192, 60
_CALIBRATION = 128  # clouds

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DiscoveryAblation:
    """One thing to leave out.

    Attributes:
        name: Of it, for tables.
        applies: Whether discovery does it, for a module that is about to.
        options: Of `lightning fit`, without it.
    """

    name: str
    applies: Callable[[ArticulatedPoseModule], bool]
    options: tuple[str, ...] = ()


def _grouped(module: ArticulatedPoseModule) -> bool:
    return module.recipe.discovery.grouped


def _slides(module: ArticulatedPoseModule) -> bool:
    return module.articulated.joint_type == PRISMATIC


def _many_objects(module: ArticulatedPoseModule) -> bool:
    return _grouped(module) and _slides(module)


_NO_SLIDES = json.dumps([name for name in PROPOSALS if name != "slides"])
DISCOVERY_ABLATIONS = (
    DiscoveryAblation(NOTHING, lambda _: True),
    DiscoveryAblation(
        "templates beyond the first", lambda of: not _many_objects(of), ("--model.discovery.references", "1")
    ),
    DiscoveryAblation("objects beyond the first", _many_objects, ("--model.discovery.objects", "1")),
    DiscoveryAblation("proposals of parts that slide", _slides, ("--model.discovery.proposals", _NO_SLIDES)),
    DiscoveryAblation(
        "knowing which clouds show one object",
        _grouped,
        ("--model.discovery.grouped", "false", "--model.objective.unidirectional", "false"),
    ),
    DiscoveryAblation(
        "knowing how far objects are turned", lambda of: of.orientation.limited, ("--model.orientation_range", "180")
    ),
)


class DiscoveryStudy(WeightsStudy):
    """Of the discovery that a set of weights begins with."""

    def run(self, say: Callable[[str], None]) -> list[tuple[str, dict[str, Any]]]:
        """What is left out, and metrics without it, with the `minutes` that discovery took.

        `discovery_error` takes the place of most metrics where no parts were found.

        Raises:
            CheckpointError: if the weights have no card, a seed is the card's own, or no data can be made.
        """
        card = self.card()
        self.made(self._place, lambda: self._make_data(card), say)
        module, _ = self._told(card)
        found = []
        for ablation in (one for one in DISCOVERY_ABLATIONS if one.applies(module)):
            say(f"{self.weights.name}: discovery without {ablation.name} …")
            note = self._place / f"without {ablation.name}.json"
            metrics = self.kept(note, lambda own=ablation.options: self._discovered(card, own), ablation.options)
            found.append((ablation.name, metrics))
        return found

    @property
    def _place(self) -> Path:
        return self.build / f"{self.weights.name}-discovery-seed-{self.seed}"

    def _make_data(self, card: WeightsCard) -> None:
        objects = _OBJECTS if card.setting is None else _OBJECTS_IN_STATES
        make_data(card, self.seed, self._place, objects)
        if "scans" in card.data:
            scans = replace(card, data=card.data | {"command": card.data["scans"]})
            make_data(scans, self.seed + 1, self._place / "scans", objects)

    def _told(self, card: WeightsCard, *options: str) -> tuple[ArticulatedPoseModule, ArticulatedDataModule]:
        """Module and data as the card's training has them before its first step, but for some options."""
        words = shlex.split(card.training["command"])[2:]  # without `lightning fit`
        places = {"--data.root": self._place / "data", "--data.max_test_samples": self.samples}
        if "--data.scans" in words:
            scans = set_folder(self._place / "scans" / "data", card.category, "procedural", "complete", None)
            places["--data.scans"] = scans
        told = [word for name, value in places.items() for word in (name, str(value))]
        parser = _parser()
        config = parser.parse_args([*words, *told, *options])
        seed_everything(config.seed_everything, verbose=False)
        built = parser.instantiate(config)
        return built.model, built.data

    def _discovered(self, card: WeightsCard, options: Sequence[str]) -> dict[str, Any]:
        with shown():
            return _discovered(*self._told(card, *options))


def _parser() -> ArgumentParser:
    """Reads what `lightning fit` does, of which the trainer's options are of no use."""
    parser = ArgumentParser()
    parser.add_argument("-c", action="config")
    parser.add_argument("--seed_everything", type=int, default=0)
    parser.add_argument("--trainer", type=dict[str, Any], default={})
    parser.add_class_arguments(ArticulatedPoseModule, "model")
    parser.add_class_arguments(ArticulatedDataModule, "data")
    parser.link_arguments("data.category", "model.category")
    return parser


@torch.no_grad()
def _discovered(module: ArticulatedPoseModule, data: ArticulatedDataModule) -> dict[str, Any]:
    """Discover, search the shape in the test clouds, and score."""
    data.setup("fit")
    data.setup("test")
    start = time.monotonic()
    try:
        module.recipe.prepare(SetClouds(data), data.hparams.num_points)
    except DiscoveryError as error:
        return {"discovery_error": str(error), "samples": 0, MINUTES: (time.monotonic() - start) / 60}
    minutes = (time.monotonic() - start) / 60
    known = [module.whole(batch) for batch in data.calibration_dataloader(_CALIBRATION)]
    labels = {name: torch.cat([batch[name] for batch in known]) for name in known[0]}
    calibration = calibrate(concatenate([module.search_batch(batch) for batch in known]), labels)
    metrics = ArticulatedPoseMetrics(calibration)
    batches = [module.whole(batch) for batch in data.test_dataloader()]
    for batch in announced(log, "test clouds", batches):
        metrics.update(module.search_batch(batch), batch)
    return metrics.compute() | {MINUTES: minutes}


def as_markdown(found: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """A table, a row for each thing that was left out."""
    return table_of("discovery without", [[name, *_cells(metrics)] for name, metrics in found], MINUTES)


def _cells(metrics: dict[str, Any]) -> list[str]:
    minutes = f"{metrics[MINUTES]:.0f}"
    if "discovery_error" in metrics:
        return ["no parts found", *["–"] * 6, minutes]
    return [*cells_of(metrics), minutes]
