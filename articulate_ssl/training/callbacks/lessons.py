"""Lessons after the last step, each of which leaves a checkpoint: a run that is cut off among them goes on there."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from lightning.pytorch import Callback, Trainer

from articulate_ssl.ops.progress import tell
from articulate_ssl.training.callbacks.keep_last import write_last
from articulate_ssl.training.lessons import LESSONS, teach
from articulate_ssl.training.set_clouds import SetClouds

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

log = logging.getLogger(__name__)


class TeachLessons(Callback):
    """Lets a module learn what comes after its last step, before that step's own checkpoint is written.

    All of it can take longer than all steps, so `last.ckpt`, where one is kept, is written before the first lesson and
    after each. A run that goes on from there has no step left: it takes the lessons that are missing.
    """

    def __init__(self) -> None:
        self._learnt: list[str] | None = None  # since the last step; None before it, or where an older run ended

    def state_dict(self) -> dict[str, Any]:
        """For checkpoints."""
        return {"learnt": self._learnt}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Of a checkpoint."""
        self._learnt = state_dict["learnt"]

    def on_train_batch_end(self, trainer: Trainer, pl_module: ArticulatedPoseModule, *_) -> None:
        """At the last step only. What a run that ended earlier has learnt, one that goes on from it learns anew."""
        if trainer.global_step == trainer.max_steps and pl_module.calibration_samples:
            self._learnt = []
            write_last(trainer)
            self._teach(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: ArticulatedPoseModule) -> None:
        """Of a run that begins behind its last step, for which no hook of the training is called."""
        if trainer.global_step == trainer.max_steps and self._missing():
            tell(log, "goes on with what is learnt after the last step: %s are done", len(self._learnt))
            pl_module.to(trainer.strategy.root_device)  # Lightning has put it away
            self._teach(trainer, pl_module)

    def _missing(self) -> list[str]:
        return [] if self._learnt is None else [lesson for lesson in LESSONS if lesson not in self._learnt]

    def _teach(self, trainer: Trainer, module: ArticulatedPoseModule) -> None:
        clouds = SetClouds(trainer.datamodule)
        for lesson in self._missing():
            taught = teach(module, clouds, (lesson,))
            self._learnt.append(lesson)
            if taught or not self._missing():
                write_last(trainer)
