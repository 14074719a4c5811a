"""What `lightning test` collects and writes: calibrated metrics, timing, and a picture of typical clouds."""

from __future__ import annotations

from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from articulate_ssl.inference.pictures.picture import SampleRow, draw_test_samples
from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.metrics.report import write_report
from articulate_ssl.training.columns import CSV_NAME, as_csv, as_table
from datamodules.atomic import atomic_write
from datamodules.manifest import Manifest

PICTURE_NAME = "test_samples.png"


def typical(error: Tensor) -> dict[str, int]:
    """Which of the clouds [S] are the best, the median and the worst, by their errors."""
    order = error.argsort().tolist()
    return {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}


class TestReport:
    """Scores batches of test clouds against a calibration measured on training clouds.

    Args:
        predictions: Of the calibration clouds, batch by batch.
        batches: Those clouds with their labels.
        upright: Whether canonical object space tells up and front, for the picture.
    """

    __test__ = False  # not a pytest class

    def __init__(self, predictions: list[Prediction], batches: list[dict[str, Tensor]], upright: bool) -> None:
        labels = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
        self.calibration = calibrate(concatenate(predictions), labels)
        self.metrics = ArticulatedPoseMetrics(self.calibration)
        self.samples: list[tuple[Tensor, Tensor, Prediction]] = []
        self.seconds, self.upright = 0.0, upright
        self._per_object: dict[str, Tensor] = {}

    def to(self, device: torch.device) -> TestReport:
        """Move calibration and metric states."""
        self.calibration = self.calibration.to(device)
        self.metrics.calibration = self.calibration
        self.metrics.to(device)
        return self

    def update(
        self,
        prediction: Prediction,
        batch: dict[str, Tensor],
        seconds: float,
        probability: Tensor | None,  # [B] that it is right, if that has been learnt
    ) -> None:
        """Add a batch of test clouds that took `seconds` to predict."""
        self.metrics.update(prediction, batch, probability)
        self.seconds += seconds
        nearest = torch.cdist(batch["points"], batch["dense_points"]).argmin(dim=-1)
        self.samples.append(
            (batch["points"].cpu(), batch["dense_part_id"].gather(1, nearest).cpu(), prediction.to("cpu"))
        )

    def compute(self) -> dict:
        """Statistics of all clouds; on every process, as they are gathered."""
        found = self.metrics.compute()
        self._per_object = self.metrics.per_object()
        return found

    def write(
        self,
        folder: Path,
        result: dict,
        manifest: Manifest,
        checkpoint: str,
        refined: bool,
        columns: dict[str, dict] | None = None,
    ) -> dict:
        """Write metrics.json, metrics.csv, objects.csv and the picture (of this process's clouds); print the table.

        Args:
            folder: Where to.
            result: What `compute` returned.
            manifest: Of the test set.
            checkpoint: Path of the weights.
            refined: Whether predictions were refined by registration.
            columns: What `TestColumns.compute` returned, if that was asked for; their table is printed, too.

        Returns:
            The content of metrics.json.
        """
        error = dim_zero_cat(self.metrics.r_err_deg).mean(dim=1).cpu()
        content = write_report(
            folder,
            result,
            category=manifest.category,
            source=manifest.source,
            protocol=manifest.protocol or manifest.view,
            checkpoint=checkpoint,
            seconds_per_cloud=self.seconds / max(1, sum(len(points) for points, *_ in self.samples)),
            per_object=(self._per_object, manifest.instances["test"]),
            part_names=list(manifest.part_names),
            refined=refined,
            calibration=self.calibration.to_dict(),
            **({} if columns is None else {"columns": columns}),
        )
        if columns is not None:
            with atomic_write(folder / CSV_NAME) as file:
                file.write(as_csv(columns, list(manifest.part_names)).encode())
            Console().print(as_table(columns, list(manifest.part_names)))
        self._draw(folder / PICTURE_NAME, error)
        return content

    def _draw(self, path: Path, error: Tensor) -> None:
        points = torch.cat([p for p, *_ in self.samples])
        truth = self.calibration.slot_of_part.cpu()[torch.cat([t for _, t, _ in self.samples])]
        prediction = concatenate([p for *_, p in self.samples])
        rows = []
        for name, i in typical(error).items():
            title = f"{name}: mean R error {error[i]:.1f}°"
            rows.append(SampleRow(title, points[i].numpy(), prediction[i : i + 1], truth[i].numpy(), self.upright))
        draw_test_samples(rows, path)
