"""The LightningModule: trains a model by a recipe, and tests it honestly."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.losses.objective import rigid_loss
from articulate_ssl.metrics.report import MULTI_STATE
from articulate_ssl.ops.progress import announced
from articulate_ssl.ops.ranks import of_all_ranks
from articulate_ssl.training.callbacks.lessons import TeachLessons
from articulate_ssl.training.columns import TestColumns
from articulate_ssl.training.hub import HubWeights
from articulate_ssl.training.label_free_report import LabelFreeReport
from articulate_ssl.training.model import ArticulatedPoseModel
from articulate_ssl.training.recipes.recipe import Outcome
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.test_report import TestReport
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import split_labels
from datamodules.manifest import Manifest

log = logging.getLogger(__name__)

# Terms of the loss, by the names that they are logged under.
_LOGGED = {
    "loss": "loss",
    "rec": "reconstruction",
    "reg": "joints",
    "distill": "distillation",
    "deviation": "deviation",
    "seg": "segmentation",
}
_CONFIDENCE_WEIGHT = 0.02  # of a batch in the running mean of adjacency confidences, once fifty are seen


class ArticulatedPoseModule(ArticulatedPoseModel, LightningModule, HubWeights):
    """Self-supervised category-level articulated object pose estimation.

    Trains and tests an `ArticulatedPoseModel`, which says what the options are and what is wrong with them.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.save_hyperparameters(self.options, logger=False)

    # Training

    def configure_callbacks(self) -> list[Callback]:
        """Lessons belong to the last step."""
        return [TeachLessons()]

    def configure_optimizers(self) -> dict[str, Any]:
        """Adam; the category's shapes and joints are a group of their own."""
        shared = list(self.articulated.category.parameters())
        # What is learnt after the last step is not trained with the rest, nor when a run that ended goes on.
        taught = self.two_ways, self.hinge_sides, self.sliding, self.view_search, self.object_frame
        taught += self.pose_network, self.box_turns, self.closed_views
        elsewhere = set(map(id, (*shared, *(parameter for some in taught for parameter in some.parameters()))))
        others = [p for p in self.parameters() if id(p) not in elsewhere]
        optimizer = torch.optim.Adam(
            [{"params": others}, {"params": shared}], lr=self.schedule.learning_rate, betas=(0.9, 0.999), eps=1e-8
        )
        rates = [self.recipe.network_rate, self.recipe.category_rate]
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rates)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def setup(self, stage: str) -> None:
        """Mixed precision, if the trainer asks for it, is for the backbones."""
        mixed = "mixed" in str(self.trainer.precision)
        for network in (self.articulated, self.rigid):
            if network is not None:
                network.mixed_precision = mixed

    def on_train_start(self) -> None:
        """Refuse data that move farther than the model does; stage 0 starts from one of their clouds."""
        data = self.trainer.datamodule
        if isinstance(data, ArticulatedDataModule):  # benchmarks train on clouds of no set
            _require_range(data.manifest, self.hparams.state_range)
        self.num_points = data.hparams.num_points
        if self.rigid is not None and self.global_step == 0:
            self.rigid.start_from(SetClouds(data).clouds(1)[0].to(self.device))

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """One step of stage 0, or of the recipe; under autocast only the backbones run in low precision."""
        with torch.autocast(self.device.type, enabled=False):
            points = split_labels(batch)[0]["points"].float()
            self.radius.follow(of_all_ranks(points), self.global_step)
            if self.global_step < self.schedule.rigid_steps:
                loss = rigid_loss(self.rigid(points), points, self.estimator.observation.bidirectional)
                self.log("loss", of_all_ranks(loss[None]).mean(), prog_bar=True)
                return loss
            if not self.recipe.ready:
                self._prepare()
            outcome = self.recipe.step(points, self.global_step, self._step_generator)
            self._track(outcome)
            return outcome.loss

    def _prepare(self) -> None:
        """Let one rank find out what the recipe needs, and all take it over: found twice, it might differ in digits."""
        found = None
        if self.global_rank == 0:
            try:
                self.recipe.prepare(SetClouds(self.trainer.datamodule), self.num_points)
                # In the host's memory: what is sent from one GPU would arrive on that GPU.
                found = {name: value.cpu() for name, value in self.state_dict().items()}, self.recipe.kept()
            except Exception as error:
                found = error  # the other ranks must not wait for what never comes
        found = self.trainer.strategy.broadcast(found)
        if isinstance(found, Exception):
            raise found
        state, kept = found
        self.load_state_dict(state)
        self.to(self.device)  # buffers that are as long as what was found are new
        self.recipe.restore(kept)

    def _step_generator(self) -> torch.Generator:
        """Of what is random in this step, the same on every rank."""
        return torch.Generator().manual_seed(self.global_step)

    @torch.no_grad()
    def _track(self, outcome: Outcome) -> None:
        """Log the terms and the warning signs (design 3.5); follow joint states, and a tree that is learnt.

        All of it is of the clouds of all ranks.
        """
        terms, selected = outcome.terms, outcome.selected
        if self.recipe.learns_tree:
            weight = max(_CONFIDENCE_WEIGHT, 1 / (self.global_step + 1))
            self.articulated.category.follow(of_all_ranks(selected.structure.confidence), weight)
        state = of_all_ranks(selected.state[:, 0])
        self.states.follow(state)
        occupancy = of_all_ranks(one_hot(terms.association.argmax(dim=-1), self.num_parts).float().mean(dim=1))
        spread = state.std(dim=0).mean() if len(state) > 1 else state.new_zeros(())
        averaged = of_all_ranks(torch.stack([getattr(terms, field) for field in _LOGGED.values()])[None]).mean(dim=0)
        self.log_dict(
            {
                **dict(zip(_LOGGED, averaged, strict=True)),
                "state_spread": spread.rad2deg() if self.articulated.joint_type == REVOLUTE else spread,
                "smallest_part": occupancy.mean(dim=0).min(),
            },
            prog_bar=True,
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Mark the checkpoint as ours, and keep what the recipe needs to resume."""
        checkpoint[CHECKPOINT_KEY] = {"version": 2, "num_points": self.num_points, "recipe": self.recipe.kept()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take it back."""
        self.restore(checkpoint[CHECKPOINT_KEY])

    # Validation and test

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Reconstruction error of held-out rotations of training clouds; no label is read."""
        points = split_labels(batch)[0]["points"]
        if self.global_step < self.schedule.rigid_steps or not self.recipe.ready:
            return
        error = self.predict_points(points, refine=False).reconstruction_error.mean()
        self.log("val_reconstruction", error, prog_bar=True, batch_size=len(points), sync_dist=True)

    def on_test_start(self) -> None:
        """Relate slots and canonical spaces to the labelled ones, on training clouds; without labels, nothing."""
        self.test_columns = None
        if not self.trainer.datamodule.manifest.labelled:
            if self.inference.columns:
                raise ValueError("inference.columns compares errors, and the set has no labels; leave it out")
            self.test_report = LabelFreeReport(self.predict_standing, self.orientation.limited).to(self.device)
            return
        loader = self.trainer.datamodule.calibration_dataloader(self.calibration_samples)
        batches = [self.whole(self.transfer_batch_to_device(batch, self.device, 0)) for batch in loader]
        shown = announced(log, "calibration on training clouds", batches)
        predictions = [self.predict_batch(batch) for batch in shown]
        self.test_report = TestReport(predictions, batches, self.orientation.limited).to(self.device)
        if self.inference.columns:
            self.test_columns = TestColumns(self.predict_batch, self.search_batch, self.inference.refine, batches)

    def test_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Predict, then compare."""
        batch = self.whole(batch)
        start = time.perf_counter()
        prediction = self.predict_batch(batch)
        seconds = time.perf_counter() - start
        known = self.confidence.learnt
        probability = self.confidence_of(prediction, batch["points"])[0] if known else None
        self.test_report.update(prediction, batch, seconds, probability)
        if self.test_columns is not None:
            self.test_columns.update(batch)

    def predict_batch(self, batch: dict[str, Tensor], refine: bool | None = None) -> Prediction:
        """Predictions of a batch of the data module that is `whole`; no label is read."""
        inputs = split_labels(batch)[0]
        return self.predict_standing(inputs["points"], refine, inputs["dense_points"])

    def search_batch(self, batch: dict[str, Tensor]) -> Prediction:
        """The same without the network (`PoseEstimator.search`)."""
        inputs = split_labels(batch)[0]
        return self.standing_part.stood(self.estimator.search(inputs["points"], inputs["dense_points"]))

    def whole(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """The batch with as many points as registration reads; the networks still see those that they would."""
        count = max(batch["points"].shape[1], self.inference.points)
        return batch | {"points": batch["dense_points"][:, :count]}

    def on_test_end(self) -> None:
        """Write metrics.json, metrics.csv, objects.csv and the picture of best, median and worst samples."""
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir)
        data = self.trainer.datamodule
        metrics = self.test_report.compute()  # on every rank: it gathers
        compared = () if self.test_columns is None else (self.test_columns.compute(metrics, self.test_report),)
        if self.recipe.multi_state:
            metrics = {"setting": MULTI_STATE} | metrics
        if self.trainer.is_global_zero:
            checkpoint = str(self.trainer.ckpt_path)
            self.test_report.write(folder, metrics, data.manifest, checkpoint, self.inference.refine, *compared)


def _require_range(manifest: Manifest, state_range: float) -> None:
    """Joint limits of that width are learnt: what moves farther would be taken for something else, without a word."""
    degrees = manifest.options.get("range_deg")
    if degrees is not None and (width := math.radians(degrees[1] - degrees[0])) > state_range + 1e-3:
        raise ValueError(
            f"hinges of the training set move by {degrees[1] - degrees[0]:g} degrees (--range-deg), those of the model "
            f"by {math.degrees(state_range):.0f}: train with --model.state_range {width:.4f}"
        )
