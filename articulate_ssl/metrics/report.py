"""The numbers of one test run as JSON, CSV and a printed table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from torch import Tensor

from articulate_ssl.metrics import objects
from datamodules.atomic import atomic_write

JSON_NAME = "metrics.json"
CSV_NAME = "metrics.csv"
STATISTICS = ("mean", "median", "ci95")
# `setting` of what learnt from clouds that are known to show the same object; the usual one is not named.
MULTI_STATE = "multi-state"
PERCENT = (
    *("flip_rate", "above_30_rate", "seg_miou", "tree_accuracy", "root_accuracy", "legacy_seg_miou"),
    *("repeat_above_30_rate", "repeat_miou", "part_share", "probability", "margin"),
)


def rows(metrics: dict) -> Iterator[tuple[str, str, dict]]:
    """Every (quantity, of what, statistics) of a metrics dict, averages first, then single parts or joints."""
    part_names = metrics.get("part_names")
    for name, value in metrics.items():
        if not isinstance(value, dict) or not set(STATISTICS) <= set(value):
            continue
        yield name, "all", value
        for group in ("parts", "joints"):
            for index, single in enumerate(value.get(group, [])):
                named = group == "parts" and part_names
                yield name, part_names[index] if named else f"{group[:-1]} {index}", single


def as_csv(metrics: dict) -> str:
    """One line per quantity and part or joint; empty cells where a value does not exist."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["quantity", "of", "mean", "median", "ci95_low", "ci95_high"])
    for name, of, value in rows(metrics):
        writer.writerow([name, of, value["mean"], value["median"], *(value["ci95"] or (None, None))])
    return text.getvalue()


def as_table(metrics: dict) -> Table:
    """Table for people: angles in degrees, shares in percent, lengths in rest-state diagonals."""
    about = ("category", "source", "protocol", "setting")
    title = ", ".join(str(metrics[k]) for k in about if metrics.get(k) is not None)
    table = Table(title=f"{title}: {metrics['samples']} clouds, {metrics['failures']} failures")
    for column in ("quantity", "of"):
        table.add_column(column)
    for column in ("mean", "median", "95 % interval"):
        table.add_column(column, justify="right")
    previous = None
    for name, of, value in rows(metrics):
        if previous is not None and name != previous:
            table.add_section()
        interval = "-" if value["ci95"] is None else " … ".join(cell(name, v) for v in value["ci95"])
        cells = [cell(name, value["mean"]), cell(name, value["median"]), interval]
        table.add_row(name if name != previous else "", of, *cells)
        previous = name
    return table


def write_report(
    folder: str | Path,
    metrics: dict,
    *,
    category: str,
    source: str,
    protocol: str | None,
    checkpoint: str | None,
    seconds_per_cloud: float | None,
    per_object: tuple[dict[str, Tensor], Sequence[str]] | None = None,
    **meta: object,
) -> dict:
    """Write `metrics.json` and `metrics.csv` into a folder (each appears whole or not at all), and print the table.

    What is known of single objects goes to `objects.csv`.

    Args:
        folder: Made if missing.
        metrics: What `ArticulatedPoseMetrics.compute` returned.
        category: Category name.
        source: Source of the test objects.
        protocol: `complete`, `honest` or `eap`.
        checkpoint: Path of the weights; None for a method without weights.
        seconds_per_cloud: Inference time.
        per_object: What `ArticulatedPoseMetrics.per_object` returned, and the ids of the objects.
        **meta: Anything else worth keeping that JSON can hold, e.g. `calibration`; `part_names` (K strings) also head
            the rows of table and CSV.

    Returns:
        The content of `metrics.json`.

    Raises:
        ValueError: if a number is NaN or infinite, or a name of `meta` is a metric's.
    """
    meta = {"category": category, "source": source, "protocol": protocol, "checkpoint": checkpoint} | meta
    meta["seconds_per_cloud"] = seconds_per_cloud
    if clash := sorted(set(meta) & set(metrics)):
        raise ValueError(f"{', '.join(clash)}: already the name of a metric")
    content = metrics | meta
    folder = Path(folder)
    text = json.dumps(content, indent=2, allow_nan=False)
    folder.mkdir(parents=True, exist_ok=True)
    files = {JSON_NAME: text + "\n", CSV_NAME: as_csv(content)}
    if per_object is not None:
        files[objects.CSV_NAME] = objects.as_csv(*per_object)
    for name, body in files.items():
        with atomic_write(folder / name) as file:
            file.write(body.encode())
    Console().print(as_table(content))
    if per_object is not None and (said := objects.half_of_flips(*per_object)):
        Console().print(said)
    return content


def cell(name: str, value: float | None) -> str:
    """A value of a quantity as tables show it."""
    if value is None:
        return "-"
    if name in PERCENT:
        return f"{100 * value:.1f} %"
    # Joint states are degrees or lengths; three decimals serve both.
    return f"{value:.2f}" if name.endswith("_deg") else f"{value:.3f}"
