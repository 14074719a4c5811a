"""The LightningModule: owns networks and options, trains by a recipe, tests honestly, predicts."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY
from articulate_ssl.inference.confidence import Confidence, relative_error
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.inference.scan_scales import predict_scans
from articulate_ssl.inference.standing_part import StandingPart
from articulate_ssl.losses.objective import ObjectiveOptions, rigid_loss
from articulate_ssl.metrics.report import MULTI_STATE
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.options import require_at_least
from articulate_ssl.ops.progress import announced
from articulate_ssl.ops.ranks import of_all_ranks
from articulate_ssl.shape.observation import Observation
from articulate_ssl.training.callbacks.lessons import TeachLessons
from articulate_ssl.training.columns import TestColumns
from articulate_ssl.training.hub import HubWeights
from articulate_ssl.training.label_free_report import LabelFreeReport
from articulate_ssl.training.recipes import recipe_class
from articulate_ssl.training.recipes.recipe import Outcome
from articulate_ssl.training.running_statistics import RadiusStatistics
from articulate_ssl.training.schedule import ScheduleOptions
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.test_report import TestReport
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import split_labels
from datamodules.manifest import Manifest

log = logging.getLogger(__name__)

JOINT_TYPES = {"revolute": REVOLUTE, "prismatic": PRISMATIC}
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


class ArticulatedPoseModule(LightningModule, HubWeights):
    """Self-supervised category-level articulated object pose estimation.

    Args:
        category: Category name, kept in checkpoints.
        num_parts: K.
        joint_type: `revolute` or `prismatic`.
        state_range: Width of the category's articulation range: radians, or normalised length.
        recipe: `staged` (part discovery by registration, then the network) or `paper` (its objective and nothing else).
        network: Sizes of the networks.
        objective: Loss weights.
        schedule: Steps and learning rates.
        discovery: Effort of part discovery (staged recipe).
        inference: Refinement at test time.
        calibration_samples: Training clouds on which `lightning test` relates slots and canonical spaces to labels, and
            from which joint limits (`inference.state_range`) and confidence are learnt without them.
        two_ways_samples: Training clouds from which the decision between two explanations is learnt, of those that fit
            alike (`inference.two_ways`), of predictions and their rivals (`inference.surface_decision`), or of the
            turns that a collection says (`inference.sliding_search`) or simulated views (`inference.object_frame`); 0
            learns none.
        object_samples: Training clouds of whole objects, each from all its clouds, whose parts are found where some
            objects' were, as those have them and as they move (`discovery.one_object.as_others`): where parts slide,
            in the multi-state setting (`discovery.grouped`), and teach a network which part points are of
            (`inference.part_network`). Ten seconds an object, and ten minutes; 0 finds none.
        handedness_samples: Training clouds of an upright camera from which it is learnt whether some objects are mirror
            images of the others (`inference.handedness`); 0 learns nothing of it.
        part_frames_samples: Training clouds from which it is learnt which parts have faces that say how they are
            turned, where parts turn (`inference.part_frames`), and if so, of complete clouds, which shape they have in
            common (`inference.common_shape`); or, where parts slide, how views of them are (`inference.object_frame`),
            which part their points are of (`inference.view_parts`, ten minutes), and which ends of parts they show
            (`inference.front_ends`); 0 learns nothing of it.
        hinge_sides_samples: Training clouds from which it is learnt whether some objects are hinged at another side
            than most (`inference.hinge_sides`); 0 learns nothing of it.
        pose_samples: Training clouds by whose registered predictions a network learns to say poses, where parts turn
            (`inference.pose_network`); half an hour, most of it to register them. 0 learns none.
        closed_views_samples: Views of scans with doors nearly closed, which training does not show, that are sought,
            too, where simulated views teach (`inference.other_views`); 0 simulates none.
        box_turns_samples: Training clouds of boxes with doors, in which these are closed, by which a network learns
            which way round boxes are (`inference.box_turns`); 15 minutes, most of it to register them. 0 learns none.
        orientation_range: How far objects are turned from their mean orientation at most, in degrees; 180 stands for
            any orientation, less where a camera is held upright.

    Raises:
        ValueError: for an unknown recipe, joint type or proposal, for numbers that make no sense, or if rigid
            alignment, which is for any orientation, is asked for within a range.
    """

    def __init__(
        self,
        category: str,
        num_parts: int,
        joint_type: str = "revolute",
        state_range: float = math.pi / 2,
        recipe: str = "staged",
        network: NetworkOptions = NetworkOptions(),  # noqa: B008 frozen
        objective: ObjectiveOptions = ObjectiveOptions(),  # noqa: B008
        schedule: ScheduleOptions = ScheduleOptions(),  # noqa: B008
        discovery: DiscoveryOptions = DiscoveryOptions(),  # noqa: B008
        inference: InferenceOptions = InferenceOptions(),  # noqa: B008
        calibration_samples: int = 128,
        two_ways_samples: int = 2000,
        object_samples: int = 1200,
        handedness_samples: int = 256,
        part_frames_samples: int = 256,
        hinge_sides_samples: int = 2000,
        pose_samples: int = 1600,
        closed_views_samples: int = 500,
        box_turns_samples: int = 640,
        orientation_range: float = 180.0,
    ) -> None:
        super().__init__()
        options = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        observation = Observation(OrientationRange(orientation_range), objective.unidirectional)
        _check(num_parts, joint_type, state_range, observation, schedule)
        self.save_hyperparameters({name: _plain(value) for name, value in options.items()}, logger=False)
        recipe_type = recipe_class(recipe)
        if network.state_anchors is None:
            network = replace(network, state_anchors=recipe_type.state_anchors(num_parts))
        if inference.refine is None:
            inference = replace(inference, refine=recipe_type.refines)
        if inference.part_neighbours is None:
            inference = replace(inference, part_neighbours=recipe_type.part_neighbours)
        self.category, self.num_parts, self.schedule = category, num_parts, schedule
        self.inference, self.calibration_samples = inference, calibration_samples
        self.two_ways_samples, self.object_samples = two_ways_samples, object_samples
        self.handedness_samples = handedness_samples
        self.part_frames_samples, self.hinge_sides_samples = part_frames_samples, hinge_sides_samples
        self.pose_samples, self.box_turns_samples = pose_samples, box_turns_samples
        self.closed_views_samples = closed_views_samples
        require_at_least(self, **{name: 0 for name in options if name.endswith("_samples")})

        self.articulated = ArticulatedNetwork(network, num_parts, JOINT_TYPES[joint_type], state_bound=state_range)
        self.rigid = RigidAlignment(network, num_parts * network.shape_points) if schedule.rigid_steps else None
        # Without pose awareness a second estimation would repeat the first.
        iterations = network.iterations if network.pose_aware else 1
        self.estimator = PoseEstimator(
            self.articulated, self.rigid, iterations, observation, objective.posterior_scale, inference
        )
        self.two_ways, self.sliding = self.estimator.two_ways, self.estimator.sliding
        self.view_search, self.handedness = self.estimator.view_search, self.estimator.handedness
        self.hinge_sides, self.states = self.estimator.hinge_sides, self.estimator.states
        self.part_frames, self.common_shape = self.estimator.part_frames, self.estimator.common_shape
        self.object_frame, self.front_ends = self.estimator.object_frame, self.estimator.front_ends
        self.pose_network, self.box_turns = self.estimator.pose_network, self.estimator.box_turns
        self.closed_views = self.estimator.closed_views
        self.recipe = recipe_type(self.estimator, objective, schedule, discovery)
        self.radius = RadiusStatistics()
        self.standing_part = StandingPart()
        self.confidence = Confidence()
        self.num_points = 512  # of a training cloud; a scan is thinned to as many

    @property
    def orientation(self) -> OrientationRange:
        """How far objects were turned in the clouds that this was trained on."""
        return self.estimator.observation.orientation

    @property
    def state_range(self) -> Tensor:
        """[J, 2] lowest and highest joint state of training clouds, as predictions count them."""
        return self.states.known - self.hinge_sides.closed * self.hinge_sides.learnt

    # Prediction

    def predict_points(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        refine: bool | None = None,
        dense: Tensor | None = None,  # [B, P, 3] the same clouds with all their points
    ) -> Prediction:
        """See `PoseEstimator.predict`; the base is that of the network's own tree, whichever part stands."""
        return self.estimator.predict(points, self.num_points, refine, dense)

    def predict_standing(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        refine: bool | None = None,
        dense: Tensor | None = None,  # [B, P, 3] the same clouds with all their points
    ) -> Prediction:
        """The same, with the part that stands for its base, where that is known (`inference.standing_part`)."""
        return self.standing_part.stood(self.predict_points(points, refine, dense))

    def predict_clouds(
        self,
        clouds: Sequence[np.ndarray],  # each [N, 3], any unit and origin
        refine: bool | None = None,
    ) -> list[ScanEstimate]:
        """Predict scans of unknown scale: see `inference.scan_scales`."""
        radius = float(self.radius.mean), float(self.radius.spread)
        estimates = predict_scans(self.estimator, clouds, self.num_points, radius, refine)
        estimates = [self._stood(estimate) for estimate in estimates]
        return [self._with_confidence(estimate) for estimate in estimates] if self.confidence.learnt else estimates

    def _stood(self, estimate: ScanEstimate) -> ScanEstimate:
        rival = None if estimate.rival is None else self.standing_part.stood(estimate.rival)
        return replace(estimate, prediction=self.standing_part.stood(estimate.prediction), rival=rival)

    def _with_confidence(self, estimate: ScanEstimate) -> ScanEstimate:
        probability, unlike = self.confidence_of(estimate.prediction, torch.from_numpy(estimate.points)[None])
        return replace(estimate, probability=float(probability), unlike=float(unlike))

    def confidence_of(
        self,
        prediction: Prediction,
        points: Tensor,  # [B, N, 3] that were predicted
    ) -> tuple[Tensor, Tensor]:  # [B], [B]
        """Probability that predictions are right, and share of the training clouds that were explained better."""
        error = relative_error(prediction, points.to(prediction.margin))
        return self.confidence.probability(prediction.margin, error), self.confidence.unlike(error)

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
        own = checkpoint[CHECKPOINT_KEY]
        self.num_points = own["num_points"]
        self.recipe.restore(own["recipe"])

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


def _plain(value: Any) -> Any:
    """An option as a checkpoint may hold it."""
    return asdict(value) if is_dataclass(value) else value


def _require_range(manifest: Manifest, state_range: float) -> None:
    """Joint limits of that width are learnt: what moves farther would be taken for something else, without a word."""
    degrees = manifest.options.get("range_deg")
    if degrees is not None and (width := math.radians(degrees[1] - degrees[0])) > state_range + 1e-3:
        raise ValueError(
            f"hinges of the training set move by {degrees[1] - degrees[0]:g} degrees (--range-deg), those of the model "
            f"by {math.degrees(state_range):.0f}: train with --model.state_range {width:.4f}"
        )


def _check(
    num_parts: int, joint_type: str, state_range: float, observation: Observation, schedule: ScheduleOptions
) -> None:
    """Refuse options that make no sense."""
    if joint_type not in JOINT_TYPES:
        raise ValueError(f"joint_type must be one of {sorted(JOINT_TYPES)}, got {joint_type!r}")
    if num_parts < 2:
        raise ValueError(f"num_parts must be at least 2, got {num_parts}")
    if not state_range > 0:
        raise ValueError(f"state_range is {state_range}, must be larger than 0")
    if observation.orientation.limited and schedule.rigid_steps:
        raise ValueError("rigid_steps align clouds of any orientation: leave them 0, or orientation_range 180")
