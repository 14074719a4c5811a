"""The card of trained weights: what they were made from and how, what they are worth, and what they are bad at."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from articulate_ssl.inference.checkpoint_file import CheckpointError
from datamodules.atomic import atomic_write

SUFFIX = ".safetensors"  # of weights
CARD_SUFFIX = ".json"  # of the card beside them
# How clouds were taken, by the word for it in names of weights.
VIEWS = {
    "complete": "complete clouds in any orientation",
    "depth": "depth views of an upright camera (x right, y down, z forward)",
}
LICENCE = "apache-2.0"
# What people read first, and what weights are compared by (`pretrained.check`).
HEADLINES = (
    *("r_err_deg", "above_30_rate", "flip_rate", "t_err"),
    *("axis_err_deg", "pivot_err", "state_err", "seg_miou"),
)


@dataclass(frozen=True)
class WeightsCard:
    """How weights were made and what they are worth.

    Attributes:
        category: Category name.
        view: `complete` or `depth`.
        part_names: K names, in the order of the labels; the predicted parts are numbered without them.
        data: `command` that makes the data, `seed`, numbers of `train_instances` and `test_instances`; `scans`, the
            command that makes the complete clouds that taught a network for depth views, if some did.
        training: `command`, `seed`, `steps`, and `commit` of the code that ran it.
        metrics: Of the test split, as in `metrics.json` (`metrics.report`): of each quantity `mean`, `median` and
            `ci95`, the 95 % interval of the mean by a bootstrap over instances, also of single parts or joints; and
            `samples`, `instances`, `failures`.
        weaknesses: What they are bad at, in sentences.
        date: Day on which they were tested, ISO 8601.
        licence: SPDX identifier.
        setting: `multi-state` if it was known in training which clouds show the same object; None for single clouds.
    """

    category: str
    view: str
    part_names: list[str]
    data: dict[str, Any]
    training: dict[str, Any]
    metrics: dict[str, Any]
    weaknesses: list[str]
    date: str
    licence: str = LICENCE
    setting: str | None = None

    def save(self, path: str | os.PathLike) -> None:
        """Write the card as JSON, whole or not at all."""
        text = json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"
        with atomic_write(path) as file:
            file.write(text.encode())

    @staticmethod
    def load(path: str | os.PathLike) -> WeightsCard:
        """Read what `save` wrote.

        Raises:
            CheckpointError: if the file is damaged or no card.
        """
        try:
            content = json.loads(Path(path).read_text())
            return WeightsCard(**content)
        except (OSError, ValueError, TypeError) as error:
            names = ", ".join(field.name for field in fields(WeightsCard))
            raise CheckpointError(f"{path}: no card of weights ({error}); it should hold {names}") from error

    def markdown(self) -> str:
        """The card as a page."""
        lines = [
            f"# {self.category}, {VIEWS[self.view]}",
            "",
            f"Parts: {', '.join(self.part_names)}. Trained without labels; licence {self.licence}; {self.date}.",
            "",
            *self._about_setting(),
            f"Data (seed {self.data['seed']}, {self.data['train_instances']} training and "
            f"{self.data['test_instances']} test objects):",
            "",
            f"    {self.data['command']}",
            *([f"    {self.data['scans']}"] if "scans" in self.data else []),
            "",
            f"Training (seed {self.training['seed']}, {self.training['steps']} steps, "
            f"commit {self.training['commit']}):",
            "",
            f"    {self.training['command']}",
            "",
            f"Test: {self.metrics['samples']} clouds of {self.metrics['instances']} objects never seen in training.",
            "",
            "| | mean | median | 95 % interval of the mean |",
            "|---|---|---|---|",
            *(
                _row(name, self.metrics[name])
                for name in HEADLINES
                if self.metrics.get(name, {}).get("mean") is not None
            ),
            "",
            "What they are bad at:",
            "",
            *(f"- {weakness}" for weakness in self.weaknesses),
        ]
        return "\n".join(lines) + "\n"

    def _about_setting(self) -> list[str]:
        if self.setting is None:
            return []
        return [
            f"Setting: {self.setting}. Training knew which clouds show the same object, which is easier than the "
            "paper's single clouds. A prediction needs one cloud.",
            "",
        ]


def hub_card(category: str, card: WeightsCard | None) -> str:
    """README.md of a repository on the Hugging Face hub: its metadata, how to use it, and the card if there is one."""
    about = [
        "---",
        "library_name: articulate-ssl",
        f"license: {LICENCE if card is None else card.licence}",
        "tags: [articulated-objects, pose-estimation, point-cloud, self-supervised, model_hub_mixin]",
        "---",
        "",
    ]
    use = [
        "",
        "## Use",
        "",
        "    from articulate_ssl import load",
        '    prediction = load("<owner>/<this repository>").predict("scan.ply")',
        "",
    ]
    page = (
        f"# {category}\n\nWeights of articulate-ssl; nobody has written a card.\n" if card is None else card.markdown()
    )
    return "\n".join(about) + page + "\n".join(use)


def _row(name: str, value: dict) -> str:
    low, high = (None, None) if value["ci95"] is None else value["ci95"]
    cells = (f"{number:.3g}" if number is not None else "-" for number in (value["mean"], value["median"]))
    interval = "-" if low is None else f"{low:.3g} … {high:.3g}"
    return f"| `{name}` | {' | '.join(cells)} | {interval} |"
