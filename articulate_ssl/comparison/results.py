"""What a table holds, from the reports of its jobs: a value per row, quantity and part, and the paper's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

import yaml

from articulate_ssl.comparison.jobs import Job, Setting
from articulate_ssl.comparison.measured import Measured
from articulate_ssl.comparison.rows import MULTI_STATE, Row, rows_of
from articulate_ssl.comparison.statistics import Estimate, combined
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.metrics.report import MULTI_STATE as MULTI_STATE_SETTING
from articulate_ssl.metrics.report import PERCENT
from articulate_ssl.metrics.report import rows as statistics_of
from articulate_ssl.training.columns import NETWORK

ALL = "all"  # parts or joints on average

# What intervals end at, of shares and angles.
_LARGEST = {**dict.fromkeys(PERCENT, 1.0), **dict.fromkeys(("r_err_deg", "r_err_sym_deg", "axis_err_deg"), 180.0)}

_NO_REPORT = {"part_names": (), "samples": 0, "instances": 0, "calibration": {"joint_type": ()}}
# Of our rows, the one that does what the paper's own does.
_PAPERS_OWN = ("paper", f"paper_{NETWORK}")
# Given in training in the multi-state setting, and where views are taught by scans.
OBJECTS, SCANS = "which clouds show one object", "complete scans of other objects"


@dataclass(frozen=True)
class RowResult:
    """One row of the table.

    Attributes:
        row: Which.
        seeds: That are trained and tested.
        values: Of every (quantity, part or joint); `ALL` for their average. What the method does not say is missing.
        train_seconds: Mean over seeds; None if nothing is tested.
        trained_on: The devices that methods were trained on, as far as that was noted.
        seconds_per_cloud: The same.
        parameters: That were learnt.
        printed: The paper's figures of this row.
    """

    row: Row
    seeds: tuple[int, ...] = ()
    values: dict[tuple[str, str], Estimate] = field(default_factory=dict)
    train_seconds: float | None = None
    trained_on: tuple[str, ...] = ()
    seconds_per_cloud: float | None = None
    parameters: int | None = None
    printed: dict[str, float | list[float]] = field(default_factory=dict)

    def value(self, quantity: str, of: str = ALL) -> Estimate | None:
        """None for what does not exist."""
        return self.values.get((quantity, of))


@dataclass(frozen=True)
class Results:
    """One table.

    Attributes:
        setting: Category, view and effort.
        part_names: K.
        rows: In the order of the table.
        samples: Test clouds; 0 if nothing is tested.
        instances: Test objects.
        revolute: Whether states are angles.
        failed: What failed, in words.
    """

    setting: Setting
    part_names: tuple[str, ...]
    rows: tuple[RowResult, ...]
    samples: int
    instances: int
    revolute: bool
    failed: tuple[str, ...]


def collect(
    setting: Setting,
    learners: Sequence[str],
    seeds: Sequence[int],
    failed: Sequence[str],
    measured: Measured = Measured(),  # noqa: B008 frozen
) -> Results:
    """Read the reports of all jobs that have finished here, or of which one is kept."""
    found, reports = [], []
    for learner in learners:
        for row in rows_of(learner):
            jobs = [Job(setting, learner, seed) for seed in seeds] if setting.view in row.views else []
            finished = {job.seed: job.report(row.column) for job in jobs if job.finished}
            kept = {job.seed: measured.report(job, row.column) for job in jobs if measured.knows(job)}
            by_seed = dict(sorted((kept | finished).items()))
            own = list(by_seed.values())
            found.append(_row_result(row, tuple(by_seed), own, setting))
            reports += own
    first = reports[0] if reports else _NO_REPORT
    counts = first["samples"], first["instances"]
    revolute = set(first["calibration"]["joint_type"]) == {REVOLUTE}
    return Results(setting, tuple(first["part_names"]), tuple(found), *counts, revolute, tuple(failed))


def _row_result(row: Row, seeds: tuple[int, ...], reports: list[dict[str, Any]], setting: Setting) -> RowResult:
    printed = _printed(row, setting)
    if not reports:
        return RowResult(row, printed=printed)
    if any(report.get("setting") == MULTI_STATE_SETTING for report in reports):  # configurations can say so, too
        scans = (SCANS,) if row.learner == MULTI_STATE else ()
        row = replace(row, given=(*row.given, OBJECTS, *scans))
    each = [{(quantity, of): value for quantity, of, value in statistics_of(report)} for report in reports]
    values = {
        key: combined([one[key] for one in each], _LARGEST.get(key[0], math.inf))
        for key in each[0]
        if key[0] in row.quantities
    }
    return RowResult(
        row,
        seeds,
        {key: value for key, value in values.items() if value is not None},
        fmean(report["train_seconds"] for report in reports),
        tuple(sorted({report["trained_on"] for report in reports if report.get("trained_on")})),
        fmean(report["seconds_per_cloud"] for report in reports),
        reports[0]["parameters"],
        printed,
    )


def _printed(row: Row, setting: Setting) -> dict[str, Any]:
    """The paper's figures; of our rows, beside the one that does what the paper's own does."""
    if setting.test_source is not None:  # it prints nothing of other objects than its own
        return {}
    key, ours = _PAPERS_OWN
    name = key if row.name == ours else row.name if row.column is None else None
    return _paper_tables()[setting.view].get(setting.category, {}).get(name, {})


@cache
def _paper_tables() -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name("paper_tables.yaml").read_text())
