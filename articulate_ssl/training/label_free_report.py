"""What `lightning test` collects and writes where nothing is labelled: figures without truth, and typical clouds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from articulate_ssl.inference.pictures.picture import SampleRow, draw_test_samples
from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.metrics.label_free import LabelFreeMetrics
from articulate_ssl.metrics.report import write_report
from articulate_ssl.training.self_agreement import another_look
from articulate_ssl.training.test_report import PICTURE_NAME, typical
from datamodules.manifest import Manifest


class LabelFreeReport:
    """Predicts every test cloud a second time, turned and of other points, and compares; `TestReport` without labels.

    Args:
        predict: From points [B, N, 3], and the same clouds with all their points (`dense`), to a prediction.
        limited: Whether the network knows objects turned within a range only, as of a camera that is held upright; then
            clouds are tilted, not turned over.
    """

    def __init__(self, predict: Callable[..., Prediction], limited: bool) -> None:
        self.metrics = LabelFreeMetrics()
        self.seconds = 0.0
        self._predict, self._limited = predict, limited
        self._generator = torch.Generator().manual_seed(0)
        self._clouds: list[tuple[Tensor, Tensor, Prediction]] = []  # points, index of the sample, prediction

    def to(self, device: torch.device) -> LabelFreeReport:
        """Move metric states."""
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
        again, turn = another_look(batch["dense_points"], self._limited, self._generator)
        points = batch["points"], again[:, : batch["points"].shape[1]]
        self.metrics.update(
            prediction, self._predict(points[1], dense=again), points, turn, batch["instance"], probability
        )
        self.seconds += seconds
        self._clouds.append((batch["points"].cpu(), batch["sample"].cpu(), prediction.to("cpu")))

    def compute(self) -> dict:
        """Statistics of all clouds; on every process, as they are gathered."""
        return self.metrics.compute()

    def write(self, folder: Path, result: dict, manifest: Manifest, checkpoint: str, refined: bool) -> dict:
        """Write metrics.json, metrics.csv and the picture (of this process's clouds); print the table.

        Args:
            folder: Where to.
            result: What `compute` returned.
            manifest: Of the test set.
            checkpoint: Path of the weights.
            refined: Whether predictions were refined by registration.

        Returns:
            The content of metrics.json.
        """
        error = dim_zero_cat(self.metrics.relative_error).cpu()
        content = write_report(
            folder,
            result,
            category=manifest.category,
            source=manifest.source,
            protocol=manifest.protocol or manifest.view,
            checkpoint=checkpoint,
            seconds_per_cloud=self.seconds / len(error),
            refined=refined,
            labelled=False,
            split_by=manifest.split_by,
        )
        self._draw(folder / PICTURE_NAME, error, manifest)
        return content

    def _draw(self, path: Path, error: Tensor, manifest: Manifest) -> None:
        points, sample = (torch.cat(values) for values in list(zip(*self._clouds, strict=True))[:2])
        prediction = concatenate([p for *_, p in self._clouds])
        scans = manifest.scans["test"]
        copies = manifest.num_samples("test") // len(scans)
        rows = []
        for name, i in typical(error).items():
            title = f"{name}: relative error {error[i]:.3f}, {scans[int(sample[i]) // copies]}"
            one = prediction[i : i + 1]
            rows.append(SampleRow(title, points[i].numpy(), one, upright=self._limited))
        draw_test_samples(rows, path)
