"""One picture of a table: how accurate each method is, against what it is given."""

from __future__ import annotations

import os

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from articulate_ssl.baselines.method import DENSE_CLOUDS, OCCUPANCY, TEST_PARTS
from articulate_ssl.comparison.results import OBJECTS, SCANS, Results, RowResult
from datamodules.atomic import atomic_write

_WIDTH, _ROW, _FRAME = 10.0, 0.27, 1.7  # inches: of the picture, of a row, and of all that is no row
_INK, _OURS, _OTHERS, _BAND = "#222222", "#c44e52", "#4c72b0", "#f1f1f1"
# From what asks for least to what asks for most.
LEVELS = (
    "clouds only",
    "and which clouds show one object",
    "and occupancy",
    "and labels in training",
    "and parts of the test cloud",
)
_LEAST, _MOST = 0.5, 180.0  # degrees of the logarithmic axis; what is better than the least looks the same


def level(result: RowResult) -> int:
    """Index into `LEVELS` of the most that a row's method is given."""
    words = set(result.row.given)
    if TEST_PARTS in words:
        return 4
    if words - {OCCUPANCY, DENSE_CLOUDS, OBJECTS, SCANS}:
        return 3
    return 2 if OCCUPANCY in words else 1 if OBJECTS in words else 0


def draw(results: Results, path: str | os.PathLike) -> None:
    """Write the picture (PNG, 150 dpi): a line per method, in bands by what it is given, from least to most."""
    shown = [r for r in results.rows if r.value("r_err_deg") or r.value("seg_miou")]
    shown.sort(key=level)  # a stable sort: within a band the order is the table's
    lines = len(shown) + len({level(result) for result in shown})
    figure = Figure(figsize=(_WIDTH, _FRAME + _ROW * lines), dpi=150, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    names, y, last = [], 0.0, None
    for result in shown:
        if level(result) != last:
            last = level(result)
            for axes in (left, right):
                axes.axhspan(y - 0.5, y + 0.5, color=_BAND)
            names.append((y, LEVELS[last]))
            y += 1
        names.append((y, result.row.title))
        _mark(left, y, result, "r_err_deg", 1.0)
        _mark(right, y, result, "seg_miou", 100.0)
        y += 1
    left.set_yticks([place for place, _ in names], [name for _, name in names])
    for label in left.get_yticklabels():
        label.set_style("italic" if label.get_text() in LEVELS else "normal")
    left.set_ylim(lines - 0.5, -0.5)
    left.set(xscale="log", xlim=(_LEAST, _MOST), xlabel="rotation error, unfolded, degrees (lower is better)")
    left.set_xticks([1, 3, 10, 30, 90], [1, 3, 10, 30, 90])
    left.set_xticks([], minor=True)
    right.set(xlim=(0, 103), xlabel="segmentation mIoU, % (higher is better)")
    for axes in (left, right):
        axes.grid(axis="x", alpha=0.3)
        axes.tick_params(axis="y", length=0)
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
    counts = [len(result.seeds) for result in results.rows if result.seeds] or [0]
    seeds = "1 seed" if set(counts) == {1} else f"{'up to ' * (min(counts) < max(counts))}{max(counts)} seeds"
    figure.suptitle(
        f"{results.setting.title}, by what methods are given\n"
        f"{results.samples} clouds of {results.instances} unseen objects, {seeds}, "
        f"95 % intervals{', ticks are seeds' * (max(counts) > 1)}",
        color=_INK,
        fontsize="medium",
    )
    with atomic_write(path) as file:
        figure.savefig(file, format="png")


def _mark(axes: Axes, y: float, result: RowResult, quantity: str, factor: float) -> None:
    value = result.value(quantity)
    if value is None:
        return
    colour = _OTHERS if result.row.column is None else _OURS
    if value.low is not None:
        # A logarithmic axis has no place for what is below zero.
        axes.plot([max(factor * value.low, 1e-3), factor * value.high], [y, y], color=colour, linewidth=1.6, alpha=0.6)
    if len(value.of_seeds) > 1:
        each = [max(factor * mean, 1e-3) for mean in value.of_seeds]
        axes.plot(each, [y] * len(each), "|", color=colour, markersize=8)
    axes.plot([max(factor * value.mean, 1e-3)], [y], "o", color=colour, markersize=5)
