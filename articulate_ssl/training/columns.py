"""What the network is worth, and what registration: the same test clouds without either, without one, and with both.

`lightning test --model.inference.columns true` reports three ways to predict:

    no_network           the category's shape and joints, searched in each cloud (`PoseEstimator.search`)
    network              the network, nothing registered after it
    network_registered   the network, its predicted shapes registered to the cloud

What is learnt after training, decisions, looks, parts, takes part in all three: the first lacks the paper's network.
Each is calibrated on its own predictions of the same training clouds, and scored on the same test clouds.
"""

from __future__ import annotations

import csv
import io
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from rich.table import Table
from torch import Tensor

from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.calibration import Calibration, calibrate
from articulate_ssl.metrics.report import cell, rows
from articulate_ssl.ops.progress import announced
from articulate_ssl.training.weights_card import HEADLINES

if TYPE_CHECKING:
    from articulate_ssl.training.test_report import TestReport

NO_NETWORK, NETWORK, REGISTERED = "no_network", "network", "network_registered"
TITLES = {NO_NETWORK: "no network", NETWORK: "network alone", REGISTERED: "network, registered"}
CSV_NAME = "columns.csv"
SECONDS = "seconds_per_cloud"

log = logging.getLogger(__name__)


@dataclass
class _Column:
    predict: Callable[[dict[str, Tensor]], Prediction]
    calibration: Calibration
    metrics: ArticulatedPoseMetrics
    seconds: float = 0.0
    clouds: int = 0

    def update(self, batch: dict[str, Tensor]) -> None:
        start = time.perf_counter()
        prediction = self.predict(batch)
        self.seconds += time.perf_counter() - start
        self.clouds += len(batch["points"])
        self.metrics.update(prediction, batch)


class TestColumns:
    """Scores the ways that the test itself does not take, beside it.

    Args:
        predict: The network's predictions of a batch; the second argument says whether to register.
        search: Predictions of a batch without it.
        refined: Whether the test itself registers.
        batches: Calibration clouds with their labels.
    """

    __test__ = False  # not a pytest class

    def __init__(
        self,
        predict: Callable[[dict[str, Tensor], bool], Prediction],
        search: Callable[[dict[str, Tensor]], Prediction],
        refined: bool,
        batches: list[dict[str, Tensor]],
    ) -> None:
        self.own = REGISTERED if refined else NETWORK
        other = (NETWORK, partial(predict, refine=False)) if refined else (REGISTERED, partial(predict, refine=True))
        labels = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
        self._others: dict[str, _Column] = {}
        for name, way in ((NO_NETWORK, search), other):
            shown = announced(log, f"calibration, {TITLES[name]}", batches)
            found = concatenate([way(batch) for batch in shown])
            calibration = calibrate(found, labels)
            metrics = ArticulatedPoseMetrics(calibration).to(found.margin.device)
            self._others[name] = _Column(way, calibration, metrics)

    def update(self, batch: dict[str, Tensor]) -> None:
        """Add a batch of test clouds."""
        for column in self._others.values():
            column.update(batch)

    def compute(self, own: dict, report: TestReport) -> dict[str, dict]:
        """By name the metrics of each column, its `seconds_per_cloud` and its `calibration`; called on every rank.

        Args:
            own: Metrics of the test itself.
            report: Of the test itself.
        """
        clouds = sum(len(points) for points, *_ in report.samples)
        found = {self.own: own | _about(report.seconds, clouds, report.calibration)}
        for name, column in self._others.items():
            found[name] = column.metrics.compute() | _about(column.seconds, column.clouds, column.calibration)
        return {name: found[name] for name in TITLES}


def as_table(columns: dict[str, dict], part_names: list[str]) -> Table:
    """Means of the headline numbers of each column, for people."""
    table = Table(title="means over the same clouds")
    for heading in ("quantity", "of"):
        table.add_column(heading)
    for name in columns:
        table.add_column(TITLES[name], justify="right")
    for quantity, of, values in _rows(columns, part_names):
        table.add_row(quantity, of, *(cell(quantity, value["mean"]) for value in values))
    table.add_section()
    table.add_row(SECONDS, "all", *(f"{column[SECONDS]:.3f}" for column in columns.values()))
    return table


def as_csv(columns: dict[str, dict], part_names: list[str]) -> str:
    """One line per headline number and part or joint; mean and median of each column."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    statistics = ("mean", "median")
    writer.writerow(["quantity", "of", *(f"{name}_{which}" for name in columns for which in statistics)])
    for quantity, of, values in _rows(columns, part_names):
        writer.writerow([quantity, of, *(value[which] for value in values for which in statistics)])
    writer.writerow([SECONDS, "all", *(value for column in columns.values() for value in (column[SECONDS], None))])
    return text.getvalue()


def _rows(columns: dict[str, dict], part_names: list[str]) -> list[tuple[str, str, list[dict]]]:
    """Quantity, of what, and its statistics in every column."""
    each = [{row[:2]: row[2] for row in rows(column | {"part_names": part_names})} for column in columns.values()]
    return [(*key, [column[key] for column in each]) for key in each[0] if key[0] in HEADLINES]


def _about(seconds: float, clouds: int, calibration: Calibration) -> dict:
    return {SECONDS: seconds / max(1, clouds), "calibration": calibration.to_dict()}
