"""What `lightning test` found, for Weights & Biases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import WandbLogger

from articulate_ssl.metrics.report import JSON_NAME
from articulate_ssl.training.test_report import PICTURE_NAME


class SendTestResults(Callback):
    """Sends the mean of every metric, and the picture of best, median and worst samples, if there is such a logger."""

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """After the module has written them."""
        loggers = [logger for logger in trainer.loggers if isinstance(logger, WandbLogger)]
        folder = Path(trainer.log_dir or trainer.default_root_dir)
        if stage != "test" or not trainer.is_global_zero or not (folder / JSON_NAME).is_file():
            return
        metrics = json.loads((folder / JSON_NAME).read_text())
        for logger in loggers:
            logger.log_metrics(means(metrics))
            logger.log_image("test_samples", [str(folder / PICTURE_NAME)])


def means(metrics: dict[str, Any]) -> dict[str, float]:
    """`test/<metric>`: the mean, of what has one in a metrics.json."""
    found = {name: value.get("mean") for name, value in metrics.items() if isinstance(value, dict)}
    return {f"test/{name}": mean for name, mean in found.items() if mean is not None}
