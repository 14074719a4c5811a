"""Do the numbers on the cards come out again? Shipped weights on fresh objects, of a seed that nothing was made with.

A card's mean and a fresh one are means over different objects: they differ by chance, by as much as both intervals
allow. A number is reproduced if the difference is no larger than the two half-intervals towards each other, added as
independent errors are. Of reproducible numbers one in twenty falls outside, half of those on the worse side; with few
test objects, for which the bootstrap is too narrow, more do.
"""

from __future__ import annotations

import json
import logging
import math
import shlex
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from scipy.stats import binom

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.metrics.report import JSON_NAME
from articulate_ssl.pretrained.fingerprint import fingerprint
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.shipped_weights import ShippedWeights
from articulate_ssl.training.weights_card import CARD_SUFFIX, HEADLINES, WeightsCard
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.atomic import atomic_write

HIGHER_IS_BETTER = ("seg_miou",)
# Training objects of the fresh set: slots and canonical frames are calibrated on 128 of their clouds, four of each.
CALIBRATION_INSTANCES = 32
_BATCH = 16
# A difference that nobody cares for, where a bootstrap of equal values (no flip at all) leaves no interval: half a
# degree, a hundredth of the clouds, or of the object's size.
_TRIFLE_DEGREES, _TRIFLE_SHARE = 0.5, 0.01
_OUTSIDE_BY_CHANCE = 0.025  # on the worse side
_SIGNIFICANT = 0.01


@dataclass(frozen=True)
class Comparison:
    """One number of a card against fresh data.

    Attributes:
        weights: Name of the weights.
        quantity: Key of `metrics.json`.
        card: Mean on the card.
        fresh: Mean on fresh data.
        allowed: How much worse than on the card chance makes it.
    """

    weights: str
    quantity: str
    card: float
    fresh: float
    allowed: float

    @property
    def worse(self) -> bool:
        """Whether chance does not explain how much worse it is."""
        return self._difference > self.allowed

    @property
    def _difference(self) -> float:
        return (self.card - self.fresh) if self.quantity in HIGHER_IS_BETTER else (self.fresh - self.card)


def check(
    weights: ShippedWeights,
    seed: int,
    build: Path,
    say: Callable[[str], None],
) -> list[Comparison]:
    """Make data of another seed as the card says, test on them, and compare; what has been tested is not repeated.

    Raises:
        CheckpointError: if the weights have no card, the seed is the card's own, or no data can be made.
    """
    card = WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX))
    place = build / f"{weights.name}-seed-{seed}"
    note, of = place / "tested.json", fingerprint(weights.file)
    if not note.is_file() or json.loads(note.read_text()).get("of") != of:
        say(f"{weights.name}: data of seed {seed} …")
        make_data(card, seed, place)
        say(f"{weights.name}: test …")
        module = load_module(weights.file)
        metrics = tested(module, data_of(card, place / "data", module.num_points), place)
        with atomic_write(note) as file:
            file.write(json.dumps({"of": of, "metrics": metrics}).encode())
    return compare(weights.name, card.metrics, json.loads(note.read_text())["metrics"])


def compare(
    name: str,
    card: dict[str, Any],  # metrics
    fresh: dict[str, Any],
) -> list[Comparison]:
    """Every headline number that both have."""
    found = []
    for quantity in HEADLINES:
        old, new = card[quantity], fresh[quantity]
        if old["mean"] is None or new["mean"] is None:
            continue
        allowed = _allowed(quantity, old, new)
        found.append(Comparison(name, quantity, old["mean"], new["mean"], allowed))
    return found


def more_than_chance(comparisons: list[Comparison]) -> bool:
    """Whether more numbers are worse than chance makes in ninety-nine of a hundred checks."""
    worse = sum(comparison.worse for comparison in comparisons)
    return worse > binom.ppf(1 - _SIGNIFICANT, len(comparisons), _OUTSIDE_BY_CHANCE)


def _allowed(quantity: str, card: dict[str, Any], fresh: dict[str, Any]) -> float:
    """The half-interval of the card on its worse side, and of the fresh mean on its better one, as independent errors.

    Infinite where one of them has no interval: one object says nothing about others.
    """
    if card["ci95"] is None or fresh["ci95"] is None:
        return math.inf
    worse, better = (0, 1) if quantity in HIGHER_IS_BETTER else (1, 0)
    chance = math.hypot(card["ci95"][worse] - card["mean"], fresh["ci95"][better] - fresh["mean"])
    in_degrees = quantity.endswith("_deg") or (quantity == "state_err" and card["mean"] > 1)
    return max(chance, _TRIFLE_DEGREES if in_degrees else _TRIFLE_SHARE)


def make_data(card: WeightsCard, seed: int, place: Path, training_objects: int = CALIBRATION_INSTANCES) -> None:
    """Data of another seed as the card says, in a folder `data` of a place; fewer training objects are enough.

    Args:
        training_objects: As many at most; by default those that calibration takes.

    Raises:
        CheckpointError: if the seed is the card's own, or no data can be made.
    """
    if seed == card.data["seed"]:
        raise CheckpointError(f"seed {seed} is that of the data behind {card.category}-{card.view}; take another")
    words = shlex.split(card.data["command"])[1:]  # `python` is this one
    words[words.index("--seed") + 1] = str(seed)
    train = words.index("--train-instances") + 1
    words[train] = str(min(int(words[train]), training_objects))
    place.mkdir(parents=True, exist_ok=True)
    log = place / "data.log"
    with log.open("w") as output:
        command = [sys.executable, *words, "--workers", "1", "--out", str(place / "data")]
        code = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False).returncode
    if code:
        raise CheckpointError(f"{place}: the data could not be made (exit code {code}); {log} says why")


def data_of(
    card: WeightsCard, root: Path, num_points: int, samples: int | None = None, scans: Path | None = None
) -> ArticulatedDataModule:
    """Data as the card's are, in a folder that `render.generate` wrote to; test clouds are as many, or `samples`.

    Args:
        scans: Folder of the set of complete clouds that taught views.
    """
    return ArticulatedDataModule(
        card.category,
        root=str(root),
        view="complete" if card.view == "complete" else "partial",
        num_points=num_points,
        batch_size=_BATCH,
        max_test_samples=samples or card.metrics["samples"],
        scans=None if scans is None else str(scans),
    )


def tested(module: ArticulatedPoseModule, data: ArticulatedDataModule, place: Path) -> dict[str, Any]:
    """The content of the `metrics.json` that a test leaves in a folder."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    trainer = Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        default_root_dir=place,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning's, about itself and about loaders without workers
        trainer.test(module, data, verbose=False)
    return json.loads((place / JSON_NAME).read_text())
