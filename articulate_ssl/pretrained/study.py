"""What studies of shipped weights have in common: a card, and results that stay valid while weights and code do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from articulate_ssl.pretrained.fingerprint import fingerprint
from articulate_ssl.training.shipped_weights import ShippedWeights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard
from datamodules.atomic import atomic_write


@dataclass(frozen=True)
class WeightsStudy:
    """Of one set of weights.

    Attributes:
        weights: Which.
        seed: Of the data; of scans that teach views, where they are made anew, it is the next.
        samples: Test clouds, at most, spread over objects and states.
        build: Folder for data and results; what is finished there is not repeated unless weights or code change.
    """

    weights: ShippedWeights
    seed: int
    samples: int
    build: Path

    def card(self) -> WeightsCard:
        """Of the weights.

        Raises:
            CheckpointError: if they have none.
        """
        return WeightsCard.load(self.weights.file.with_suffix(CARD_SUFFIX))

    def made(self, place: Path, make: Callable[[], None], say: Callable[[str], None]) -> None:
        """Make the data of a place, once."""
        if not (place / "made").is_file():
            say(f"{self.weights.name}: data of seed {self.seed} …")
            make()
            (place / "made").touch()

    def kept(self, note: Path, measure: Callable[[], dict[str, Any]], *options: object) -> dict[str, Any]:
        """Metrics that lie in a file, or are measured and put there.

        Args:
            options: What else they depend on.
        """
        about = fingerprint(self.weights.file, *options, self.samples)
        if note.is_file() and (known := json.loads(note.read_text()))["of"] == about:
            return known["metrics"]
        metrics = measure()
        with atomic_write(note) as file:
            file.write(json.dumps({"of": about, "metrics": metrics}).encode())
        return metrics
