"""Accuracy against noise of the points (paper, appendix "Robustness to Input Data Noise", whose sigma is .02)."""

from __future__ import annotations

import csv
import io
import logging
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.ops.progress import announced
from articulate_ssl.training.module import ArticulatedPoseModule
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.atomic import atomic_write

SIGMAS = (0.0, 0.005, 0.01, 0.02, 0.03)  # normalised units: shares of the object's diagonal
PAPERS_SIGMA = 0.02
# Each is drawn and listed: key of the metrics, statistic, title, what to multiply by.
QUANTITIES = (
    ("r_err_deg", "median", "rotation error, median (degrees)", 1),
    ("flip_rate", "mean", "flips (%)", 100),
    ("seg_miou", "mean", "segmentation mIoU (%)", 100),
)
WAYS = {False: "network alone", True: "network, registered"}
_STATISTICS = ("mean", "median", "low", "high")

log = logging.getLogger(__name__)


def measure(
    module: ArticulatedPoseModule,
    data_options: dict,
    calibration_samples: int = 128,
) -> dict[bool, list[dict]]:
    """Metrics (`ArticulatedPoseMetrics.compute`) for every one of `SIGMAS`, without registration and with it.

    Slots and canonical spaces are related to the labelled ones on training clouds without noise.

    Args:
        data_options: Arguments of `ArticulatedDataModule`.
    """
    clean = ArticulatedDataModule(**data_options, test_noise_std=0.0)
    clean.setup("test")
    known = [module.whole(batch) for batch in clean.calibration_dataloader(calibration_samples)]
    labels = {name: torch.cat([batch[name] for batch in known]) for name in known[0]}
    calibrations = {
        refine: calibrate(concatenate([module.predict_batch(batch, refine) for batch in known]), labels)
        for refine in WAYS
    }
    found: dict[bool, list[dict]] = {refine: [] for refine in WAYS}
    for sigma in SIGMAS:
        noisy = ArticulatedDataModule(**data_options, test_noise_std=sigma)
        noisy.setup("test")
        batches = [module.whole(batch) for batch in noisy.test_dataloader()]
        metrics = {refine: ArticulatedPoseMetrics(calibration) for refine, calibration in calibrations.items()}
        for batch in announced(log, f"noise of {sigma:g}", batches):
            for refine, own in metrics.items():
                own.update(module.predict_batch(batch, refine), batch)
        for refine, own in metrics.items():
            found[refine].append(own.compute())
    return found


def write(
    found: dict[bool, list[dict]],
    title: str,
    folder: Path,
) -> list[Path]:
    """`noise.csv`, with all numbers, and `noise.png`."""
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["way", "sigma", *(f"{name}_{which}" for name, *_ in QUANTITIES for which in _STATISTICS)])
    for refine, metrics in found.items():
        for sigma, at in zip(SIGMAS, metrics, strict=True):
            values = (at[name] for name, *_ in QUANTITIES)
            cells = [c for v in values for c in (v["mean"], v["median"], *(v["ci95"] or ("", "")))]
            writer.writerow([WAYS[refine], sigma, *cells])
    picture = folder / "noise.png"
    with atomic_write(folder / "noise.csv") as file:
        file.write(table.getvalue().encode())
    with atomic_write(picture) as file:
        _drawn(found, title).savefig(file, format="png")
    return [folder / "noise.csv", picture]


def _drawn(found: dict[bool, list[dict]], title: str) -> Figure:
    figure = Figure(figsize=(11, 3.6), dpi=120, layout="constrained")
    for axes, (name, statistic, label, factor) in zip(figure.subplots(1, len(QUANTITIES)), QUANTITIES, strict=True):
        for refine, metrics in found.items():
            values = [factor * at[name][statistic] for at in metrics]
            (line,) = axes.plot(SIGMAS, values, "o-" if refine else "s--", label=WAYS[refine])
            if statistic == "mean" and metrics[0][name]["ci95"] is not None:  # intervals are of means
                low, high = factor * np.array([at[name]["ci95"] for at in metrics]).T
                axes.fill_between(SIGMAS, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
        axes.axvline(PAPERS_SIGMA, color="0.6", linewidth=0.8, linestyle=":")
        axes.set(xlabel="noise sigma / object's diagonal", title=label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(frameon=False)
    figure.suptitle(title)
    return figure
