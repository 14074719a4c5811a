"""A table as Markdown for people, and as CSV and JSON for programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict

from articulate_ssl.baselines.runner import CPU
from articulate_ssl.comparison.results import ALL, Results, RowResult
from articulate_ssl.comparison.statistics import Estimate
from articulate_ssl.metrics.report import PERCENT

NOTHING = "–"
NO_LABELS = "clouds"
# Heading, quantity, digits; those of a state are a matter of its unit.
UNFOLDED = (
    ("R °", "r_err_deg", 1),
    ("flips %", "flip_rate", 1),
    (">30° %", "above_30_rate", 1),
    ("T", "t_err", 3),
    ("axis °", "axis_err_deg", 1),
    ("pivot", "pivot_err", 3),
    ("state", "state_err", None),
    ("mIoU %", "seg_miou", 1),
    ("Chamfer", "chamfer_l1", 3),
)
# Heading, quantity, that of the paper, digits.
LEGACY = (
    ("R °", "legacy_r_err_deg", "r_err_deg", 1),
    ("T", "legacy_t_err", "t_err", 3),
    ("axis °", "legacy_axis_err_deg", "axis_err_deg", 1),
    ("pivot", "legacy_pivot_err", "pivot_err", 3),
    ("mIoU %", "legacy_seg_miou", "seg_miou", 1),
    ("Chamfer", "legacy_chamfer_l1", "chamfer_l1", 3),
)
_PRINTED = " (printed)"


def given(result: RowResult) -> str:
    """What a row's method reads, in words."""
    return ", ".join((NO_LABELS, *result.row.given))


def as_markdown(results: Results) -> str:
    """Both tables, with what a reader must know about them."""
    setting = results.setting
    lines = [
        f"# {setting.title}",
        "",
        f"{results.samples} test clouds of {results.instances} objects that no method has seen. Means over seeds and "
        "clouds, and in brackets 95 % intervals over seeds and objects (docs/comparison.md says how they are made); "
        f"{NOTHING} is what a method does not say. R is unfolded; flips and >30° count a cloud if any part is turned "
        f"by more than 90° or 30°; T and pivots are in the cloud's unit{', states in degrees' * results.revolute}.",
        "",
        *_grid(
            ["method", "given", "seeds", *(heading for heading, *_ in UNFOLDED), "train s", "s / cloud", "parameters"],
            [_unfolded(result, results.revolute) for result in results.rows],
        ),
        "",
        "The same clouds as the original code measures them (R folded to min(e, 180 - e), slots matched anew in each "
        "test cloud, pivots as scalars), beside what the paper prints of its own data, for each part "
        f"({' / '.join(results.part_names)}) or joint.",
        "",
        *_grid(
            ["method", *(title for heading, *_ in LEGACY for title in (heading, heading + _PRINTED))],
            [_legacy(result) for result in results.rows],
        ),
    ]
    if repeated := [result for result in results.rows if len(result.seeds) > 1]:
        lines += [
            "",
            "Each training by itself, in the order of the seeds: how much it is chance.",
            "",
            *_grid(
                ["method", *(heading for heading, *_ in UNFOLDED)],
                [_each_seed(row, results.revolute) for row in repeated],
            ),
        ]
    if results.failed:
        lines += ["", "Not finished:", "", *(f"- {reason}" for reason in results.failed)]
    return "\n".join(lines) + "\n"


def as_csv(results: Results) -> str:
    """One line per row, quantity and part or joint."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "given", "quantity", "of", "mean", "ci95_low", "ci95_high", "seeds", "of_seeds"])
    for result in results.rows:
        about = (result.row.name, given(result))
        seeds = " ".join(map(str, result.seeds))
        for (quantity, of), value in result.values.items():
            means = " ".join(map(str, value.of_seeds))
            writer.writerow([*about, quantity, of, value.mean, value.low, value.high, seeds, means])
        for name in ("train_seconds", "seconds_per_cloud", "parameters"):
            if (number := getattr(result, name)) is not None:
                writer.writerow([*about, name, ALL, number, None, None, seeds, None])
    return text.getvalue()


def as_json(results: Results) -> str:
    """Everything, the paper's figures too."""
    setting = results.setting
    rows = [
        {
            "name": result.row.name,
            "title": result.row.title,
            "given": list(result.row.given),
            "seeds": list(result.seeds),
            "train_seconds": result.train_seconds,
            "trained_on": list(result.trained_on),
            "seconds_per_cloud": result.seconds_per_cloud,
            "parameters": result.parameters,
            "values": [
                {"quantity": quantity, "of": of} | value._asdict() for (quantity, of), value in result.values.items()
            ],
            "printed": result.printed,
        }
        for result in results.rows
    ]
    counts = {"samples": results.samples, "instances": results.instances, "part_names": list(results.part_names)}
    content = {"setting": asdict(setting), **counts, "rows": rows, "failed": list(results.failed)}
    return json.dumps(content, indent=2, allow_nan=False, default=str) + "\n"


def _unfolded(result: RowResult, revolute: bool) -> list[str]:
    numbers = [_with_interval(result.value(quantity), quantity, digits) for quantity, digits in _quantities(revolute)]
    about = (
        NOTHING if result.train_seconds is None else f"{result.train_seconds:.0f}" + _elsewhere(result),
        NOTHING if result.seconds_per_cloud is None else f"{result.seconds_per_cloud:.3f}",
        NOTHING if result.parameters is None else f"{result.parameters:,}".replace(",", " "),
    )
    return [result.row.title, given(result), str(len(result.seeds)), *numbers, *about]


def _elsewhere(result: RowResult) -> str:
    """What seconds of a training are of, if not of CPUs alone."""
    return f" ({', '.join(result.trained_on)})" if set(result.trained_on) - {CPU} else ""


def _each_seed(result: RowResult, revolute: bool) -> list[str]:
    values = [(result.value(quantity), quantity, digits) for quantity, digits in _quantities(revolute)]
    return [
        result.row.title,
        *(
            NOTHING if value is None else " / ".join(_number(mean, quantity, digits) for mean in value.of_seeds)
            for value, quantity, digits in values
        ),
    ]


def _quantities(revolute: bool) -> list[tuple[str, int]]:
    """Of the unfolded table, with the digits of each."""
    return [(quantity, (1 if revolute else 3) if digits is None else digits) for _, quantity, digits in UNFOLDED]


def _legacy(result: RowResult) -> list[str]:
    cells = [result.row.title]
    for _, quantity, printed, digits in LEGACY:
        values = [value for (name, of), value in result.values.items() if name == quantity and of != ALL]
        values = values or [value for value in [result.value(quantity)] if value is not None]
        # The paper prints one IoU for all parts.
        if quantity == "legacy_seg_miou":
            values = [value for value in [result.value(quantity)] if value is not None]
        cells.append(" / ".join(_number(value.mean, quantity, digits) for value in values) or NOTHING)
        figures = result.printed.get(printed, [])
        figures = figures if isinstance(figures, Sequence) else [figures]
        cells.append(" / ".join(f"{figure:.{digits}f}" for figure in figures) or NOTHING)
    return cells


def _with_interval(value: Estimate | None, quantity: str, digits: int) -> str:
    if value is None:
        return NOTHING
    mean = _number(value.mean, quantity, digits)
    if value.low is None:
        return mean
    return f"{mean} [{_number(value.low, quantity, digits)}, {_number(value.high, quantity, digits)}]"


def _number(value: float, quantity: str, digits: int) -> str:
    return f"{100 * value if quantity in PERCENT else value:.{digits}f}"


def _grid(headings: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    ruler = ["---" if heading in ("method", "given") else "---:" for heading in headings]
    return ["| " + " | ".join(cells) + " |" for cells in (headings, ruler, *rows)]
