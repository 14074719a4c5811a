"""`last.ckpt` of a finished run is its last step's."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint


class KeepLast(Callback):
    """Lightning leaves `last.ckpt` where the last full interval was: up to that many steps old, without confidence."""

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write it once more, if it was ever written."""
        for callback in trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.last_model_path:
                trainer.save_checkpoint(callback.last_model_path)
