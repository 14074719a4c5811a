"""How long `lightning fit` will take, from steps that were measured on this machine."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch import Tensor

MEASURED_STEPS = 20  # of training, before the estimate is corrected; chosen: some seconds with the `cpu` profile
_WARM_SECONDS = 5.0  # a first step that takes as long says enough; a shorter one may have been mostly start-up
# Which of them apply is not known before. Of 1,000 ovens they took twice as long as all before (log, step 156).
_LESSONS = "then its lessons, without labels, which may take twice as long"
_UNITS = ((2 * 86400, 86400, "days"), (2 * 3600, 3600, "hours"), (100, 60, "minutes"), (0, 1, "seconds"))


class EstimateDuration(Callback):
    """Says how long training will take: once before it begins, and again when steps of it were measured.

    Steps are measured in place, by steps on random clouds whose gradients are thrown away: the machine, the sizes and
    the options are those of the training. Neither weights nor random numbers of the training are touched. They are
    steps of the kind that takes longest, so the first estimate is an upper bound where a recipe has others. Where
    several processes share the work, one alone would not be measured rightly, and only the second estimate is made.
    """

    def __init__(self) -> None:
        self._began = self._discovery = 0.0
        self._seconds: float | None = None  # of a step of the kind that takes longest, measured before training
        self._start: tuple[int, float] | None = None  # step and time of the first one that was nothing but a step
        self._mark = self._start  # the same, from which the kind of steps that are taken now is measured
        self._told = self._ready = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The first estimate."""
        self.__init__()
        steps = trainer.max_steps - trainer.global_step
        if steps > 0 and trainer.world_size == 1:
            self._seconds = step_seconds(pl_module, trainer.datamodule.hparams)
            bound = "at most " if pl_module.recipe.cheap_steps > trainer.global_step else "about "
            text = f"{bound}{in_words(steps * self._seconds)} for {steps} steps ({self._seconds:.2g} s, measured)"
            _say(trainer, text if pl_module.recipe.ready else f"{text}, after part discovery")

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """What comes before the first step, discovery, is measured with it."""
        if self._start is None:
            self._began, self._ready = time.perf_counter(), pl_module.recipe.ready

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """The second estimate, and what is left in the progress bar."""
        now, step, cheap = time.perf_counter(), trainer.global_step, pl_module.recipe.cheap_steps
        if self._start is None and pl_module.recipe.ready:
            self._start = self._mark = step, now
            self._discovery = 0.0 if self._ready else now - self._began
        elif self._start is not None and step == cheap:
            self._mark = step, now
        measured = 0 if self._mark is None else step - self._mark[0]
        if measured < (1 if self._told else MEASURED_STEPS) or trainer.max_steps < 0:
            return
        rate = (now - self._mark[1]) / measured
        left = _left(step, trainer.max_steps, cheap, rate, self._seconds)
        pl_module.log("minutes_left", left / 60, prog_bar=True, logger=False)
        if not self._told:
            self._told = True
            first, begun = self._start
            text = _whole(self._discovery, now - begun + left, trainer.max_steps - first)
            _say(trainer, f"{text}; {_LESSONS}" if pl_module.inference.refine else text)


def step_seconds(pl_module: LightningModule, data: Any) -> float:
    """Seconds of a training step, forwards and backwards, on random clouds.

    Args:
        pl_module: An `ArticulatedPoseModule` on its device.
        data: Hyperparameters of the data: `batch_size`, `num_points`.
    """
    seconds = _one_step(pl_module, data)
    return seconds if seconds > _WARM_SECONDS else _one_step(pl_module, data)


def in_words(seconds: float) -> str:
    """A duration: 9 minutes, 2.5 days."""
    size, unit = _unit(seconds)
    return f"{_rounded(seconds / size)} {unit}"


def _one_step(pl_module: LightningModule, data: Any) -> float:
    device = pl_module.device
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        points = torch.rand(data.batch_size, data.num_points, 3, device=device) - 0.5
        start = time.perf_counter()
        with torch.autocast(device.type, enabled=False):
            _loss(pl_module, points).backward()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
    pl_module.zero_grad(set_to_none=True)
    return seconds


def _loss(pl_module: LightningModule, points: Tensor) -> Tensor:
    """Of a step after all stages that come before: most steps are, and it asks for nothing that was found earlier."""
    return pl_module.recipe.step(points, pl_module.schedule.steps, torch.Generator).loss


def _left(step: int, steps: int, cheap: int, rate: float, longest: float | None) -> float:
    """Seconds for the steps that are left, of which those before `cheap` take `rate`.

    Args:
        step: The next one.
        steps: At which training ends.
        cheap: The first step of the kind that takes longest.
        rate: Seconds of a step now.
        longest: Seconds of a step of that kind, if it was measured.
    """
    before = max(0, min(cheap, steps) - step)
    later = rate if longest is None or not before else longest
    return before * rate + (steps - step - before) * later


def _whole(discovery: float, training: float, steps: int) -> str:
    if not discovery:
        return f"about {in_words(training)} for {steps} steps"
    size, _ = _unit(discovery + training)
    parts = f"{_rounded(discovery / size)} of part discovery, {_rounded(training / size)} for {steps} steps"
    return f"about {in_words(discovery + training)} in all: {parts}"


def _unit(seconds: float) -> tuple[int, str]:
    return next((size, unit) for least, size, unit in _UNITS if seconds >= least)


def _rounded(value: float) -> str:
    return f"{value:.1f}" if value < 3 else f"{value:.0f}"


def _say(trainer: Trainer, text: str) -> None:
    if trainer.is_global_zero:
        print(f"lightning fit: {text}", flush=True)
