"""What shipped weights are worth, as the table of README: read off their cards, so that it says what they say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any

import yaml

from articulate_ssl.metrics.report import PERCENT
from articulate_ssl.training.weights_card import WeightsCard

MARK = "‡"  # behind names of weights of another setting
# Heading, quantity, digits, and whether with its interval; digits of a state are a matter of its unit.
_COLUMNS = (
    ("R °", "r_err_deg", 1, True),
    ("flips %", "flip_rate", 1, True),
    (">30° %", "above_30_rate", 1, False),
    ("axis °", "axis_err_deg", 1, False),
    ("pivot", "pivot_err", 3, False),
    ("state °", "state_err", None, False),
    ("mIoU %", "seg_miou", 0, False),
)
_PAPER = (("r_err_deg", 1), ("axis_err_deg", 0), ("seg_miou", 0))
_VIEW_IN_PAPER = {"complete": "complete", "depth": "partial"}
_NOTHING = "–"


def as_markdown(cards: Iterable[WeightsCard], view: str) -> str:
    """A table of the weights of one view: means, some with their 95 % intervals, and what the paper prints."""
    rows = [_row(card) for card in cards if card.view == view]
    return table_of("category", rows, "objects", "paper: R (folded); axis; mIoU")


def table_of(first: str, rows: Iterable[Sequence[str]], *last: str) -> str:
    """A table whose rows have a name, `cells_of` metrics, and some more.

    Args:
        first, last: Headings.
    """
    headings = (first, *(heading for heading, *_ in _COLUMNS), *last)
    ruler = ("---", *("---:" for _ in _COLUMNS), *("---:" for _ in last[:-1]), *("---" for _ in last[-1:]))
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (headings, ruler, *rows)) + "\n"


def cells_of(metrics: dict[str, Any]) -> list[str]:
    """Means of `metrics.json`, some with their 95 % intervals."""
    cells = [_cell(metrics, quantity, digits, whole) for _, quantity, digits, whole in _COLUMNS]
    cells[0] += f", median {metrics['r_err_deg']['median']:.1f}"
    return cells


def _row(card: WeightsCard) -> list[str]:
    name = card.category + (f" {MARK}" if card.setting else "")
    return [name, *cells_of(card.metrics), str(card.metrics["instances"]), _printed(card)]


def _cell(metrics: dict[str, Any], quantity: str, digits: int | None, whole: bool) -> str:
    value = metrics[quantity]
    if value["mean"] is None:
        return _NOTHING
    if digits is None:  # what slides has states in lengths, and no pivots
        digits = 3 if metrics["pivot_err"]["mean"] is None else 1
    scale = 100 if quantity in PERCENT else 1
    mean = f"{scale * value['mean']:.{digits}f}"
    if value["ci95"] is None or not whole:
        return mean
    low, high = (f"{scale * end:.{digits}f}" for end in value["ci95"])
    return f"{mean} ({low}–{high})"


def _printed(card: WeightsCard) -> str:
    """Of the paper's own data; one figure per part or joint."""
    text = resources.files("articulate_ssl.comparison").joinpath("paper_tables.yaml").read_text()
    row = yaml.safe_load(text)[_VIEW_IN_PAPER[card.view]].get(card.category, {}).get("paper")
    if row is None:
        return _NOTHING
    values = [(row[quantity], digits) for quantity, digits in _PAPER]
    each = [(value if isinstance(value, list) else [value], digits) for value, digits in values]
    return "; ".join(" / ".join(f"{one:.{digits}f}" for one in some) for some, digits in each)
