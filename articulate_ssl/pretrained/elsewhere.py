"""What shipped weights are worth on labelled objects that the generator has nothing to do with: the user's, or CAD.

Slots and canonical frames are related to labels on generated training clouds, as ever, so that no test cloud, and no
object of the set, takes part.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from articulate_ssl.pretrained.check import data_of, make_data, tested
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import ShippedWeights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import MANIFEST_NAME, ManifestError

CALIBRATION_SEED = 57  # of the generated objects, of which nothing is tested


def measured_elsewhere(
    weights: ShippedWeights,
    source: str,
    root: Path,
    build: Path,
    say: Callable[[str], None],
    samples: int | None = None,
) -> tuple[dict[str, Any], Path]:
    """Metrics of the test split of a set of the weights' category and view.

    Args:
        weights: Which.
        source: Of the set's objects.
        root: Where sets lie.
        build: For generated clouds, which are made once, and results.
        say: Progress.
        samples: Test clouds at most; None is all.

    Returns:
        The content of `metrics.json`, and the folder that it is in, with `objects.csv` and a picture.

    Raises:
        ManifestError: if there is no such set, or it is damaged, or has no labels.
        CheckpointError: if the weights have no card, or no clouds can be generated.
    """
    card = WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX))
    module = load_module(weights.file)
    generated = build / f"{weights.name}-seed-{CALIBRATION_SEED}"
    known = data_of(card, generated / "data", module.num_points)
    data = labelled_set(source, root, known, samples)
    if not (known.folder / MANIFEST_NAME).is_file():
        say(f"{weights.name}: generated clouds, for calibration …")
        make_data(card, CALIBRATION_SEED, generated)
    say(f"{weights.name}: test on {data.folder} …")
    place = build / f"{weights.name}-on-{source}"
    return tested(module, data, place), place


def labelled_set(
    source: str, root: Path, known: ArticulatedDataModule, samples: int | None = None
) -> ArticulatedDataModule:
    """A set to test on, of which nothing is calibrated; see `measured_elsewhere`.

    Args:
        known: Generated clouds of the same category and view, which calibrate.

    Raises:
        ManifestError: if there is no such set, or it is damaged, or has no labels.
    """
    options = {name: known.hparams[name] for name in ("category", "view", "num_points", "batch_size")}
    calibration = {"calibration_set": str(known.folder), "max_test_samples": samples}
    data = ArticulatedDataModule(root=str(root), source=source, **options, **calibration)
    if not data.manifest.labelled:
        raise ManifestError(f"{data.folder}: has no labels to compare with; `lightning test` says what can be said")
    if not data.manifest.num_samples("test"):
        raise ManifestError(f"{data.folder}: has no test clouds; make it with --train-instances 0 and --test-instances")
    return data
