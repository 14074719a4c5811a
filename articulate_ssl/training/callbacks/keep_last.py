"""`last.ckpt` where work ends that takes long: after part discovery, and after the last step."""

from __future__ import annotations

from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint


class KeepLast(Callback):
    """Lightning leaves `last.ckpt` where the last full interval was: up to that many steps old, without confidence."""

    def __init__(self) -> None:
        self._discovered = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Whether discovery is still to come."""
        self._discovered = pl_module.recipe.ready

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_) -> None:
        """After the step that discovery comes before, which can take longer than all others."""
        if pl_module.recipe.ready and not self._discovered:
            self._discovered = True
            write_last(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Once more."""
        write_last(trainer)


def write_last(trainer: Trainer) -> None:
    """Write `last.ckpt` now, where it is kept at all."""
    for callback in trainer.checkpoint_callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.save_last:
            last = Path(callback.dirpath, callback.CHECKPOINT_NAME_LAST + callback.FILE_EXTENSION)
            callback.last_model_path = str(last)  # or Lightning takes it for another run's, and numbers its own
            trainer.save_checkpoint(last, weights_only=False)  # with optimiser and callbacks, or nothing could go on
