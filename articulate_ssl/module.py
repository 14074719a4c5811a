"""The LightningModule: training by either recipe, honest testing, and prediction."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningModule
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.groups import rotation_group
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY
from articulate_ssl.inference.point_cloud_io import farthest_point_order
from articulate_ssl.inference.test_report import TestReport
from articulate_ssl.network.articulated_network import ArticulatedNetwork, Hypotheses
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.chamfer import chamfer, hypothesis_distances
from articulate_ssl.options import (
    RECIPES,
    DiscoveryOptions,
    InferenceOptions,
    NetworkOptions,
    ObjectiveOptions,
    ScheduleOptions,
)
from articulate_ssl.orientation import OrientationRange
from articulate_ssl.pose_estimation import PoseEstimator
from articulate_ssl.prediction import Prediction
from articulate_ssl.recipes.objective import PoseTarget, Terms, paper_terms, staged_terms
from articulate_ssl.recipes.part_discovery import ArticulatedTemplate, discover
from datamodules.articulated_dataset import split_labels
from datamodules.geometry import PRISMATIC, REVOLUTE, invert_se3, se3, transform_points

JOINT_TYPES = {"revolute": REVOLUTE, "prismatic": PRISMATIC}


class ArticulatedPoseModule(LightningModule):
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
        calibration_samples: Training clouds on which `lightning test` relates slots and canonical spaces to labels.
        orientation_range: How far objects are turned from their mean orientation at most, in degrees; 180 stands for
            any orientation, less where a camera is held upright.

    Raises:
        ValueError: for an unknown recipe or joint type, or if rigid alignment, which is for any orientation, is asked
            for within a range.
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
        orientation_range: float = 180.0,
    ) -> None:
        super().__init__()
        if recipe not in RECIPES:
            raise ValueError(f"recipe must be one of {RECIPES}, got {recipe!r}")
        if joint_type not in JOINT_TYPES:
            raise ValueError(f"joint_type must be one of {sorted(JOINT_TYPES)}, got {joint_type!r}")
        if num_parts < 2:
            raise ValueError(f"num_parts must be at least 2, got {num_parts}")
        self.orientation = OrientationRange(orientation_range)
        if self.orientation.limited and schedule.rigid_steps:
            raise ValueError("rigid_steps align clouds of any orientation: leave them 0, or orientation_range 180")
        groups = {"network": network, "objective": objective, "schedule": schedule}
        groups |= {"discovery": discovery, "inference": inference}
        plain = {"category": category, "num_parts": num_parts, "joint_type": joint_type, "state_range": state_range}
        plain |= {"recipe": recipe, "calibration_samples": calibration_samples}
        plain |= {"orientation_range": orientation_range}
        self.save_hyperparameters(plain | {name: asdict(value) for name, value in groups.items()}, logger=False)
        self.category, self.num_parts, self.recipe = category, num_parts, recipe
        self.network_options, self.objective, self.schedule = network, objective, schedule
        self.discovery, self.inference, self.calibration_samples = discovery, inference, calibration_samples

        group = rotation_group(network.group_order)
        self.group = group
        self.articulated = ArticulatedNetwork(
            self._backbone(),
            group,
            network.dims[-1],
            network.head_dim,
            num_parts,
            network.shape_points,
            JOINT_TYPES[joint_type],
            state_bound=state_range,
            flow_bound=network.flow_bound,
            stretch_bound=network.stretch_bound,
            part_features=network.part_features,
            shared_axis=network.shared_axis,
            directions=network.directions,
        )
        self.rigid = (
            RigidAlignment(
                self._backbone(),
                group,
                network.dims[-1],
                network.head_dim,
                num_parts * network.shape_points,
                directions=network.directions,
            )
            if schedule.rigid_steps
            else None
        )
        # Without pose awareness a second estimation would repeat the first.
        iterations = network.iterations if network.pose_aware else 1
        self.estimator = PoseEstimator(self.articulated, self.rigid, iterations, objective, inference, self.orientation)
        # Of training clouds' mean distance to their centre: how a scan of unknown scale is scaled.
        self.register_buffer("radius_mean", torch.tensor(0.0))
        self.register_buffer("radius_square", torch.tensor(0.0))
        self.register_buffer("state_limits", torch.zeros(num_parts - 1, 2))
        self.registered: dict[str, Tensor] | None = None
        self.num_points = 512  # of a training cloud; a scan is thinned to as many

    def _backbone(self) -> EquivariantBackbone:
        n = self.network_options
        return EquivariantBackbone(
            n.group_order,
            n.dims,
            n.radii,
            n.num_neighbors,
            n.num_kernel_points,
            n.num_centers,
            intra=n.intra,
            separable=n.separable,
            directions=n.directions,
        )

    # Prediction

    def predict_points(self, points: Tensor, refine: bool | None = None) -> Prediction:
        """Predictions for normalised clouds [B, N, 3] in farthest-point order: see `PoseEstimator.predict`."""
        return self.estimator.predict(points, self.num_points, refine)

    def predict_cloud(
        self,
        points: np.ndarray,  # [N, 3] any unit and origin
        refine: bool | None = None,
    ) -> tuple[Prediction, np.ndarray, float, np.ndarray]:
        """Predict a scan of unknown scale: see `PoseEstimator.predict_scan`."""
        spread = (self.radius_square - self.radius_mean.square()).clamp(min=0).sqrt()
        return self.estimator.predict_scan(points, self.num_points, (float(self.radius_mean), float(spread)), refine)

    @property
    def state_range(self) -> Tensor:
        """[J, 2] lowest and highest joint state seen in training."""
        return self.state_limits

    # Training

    def configure_optimizers(self) -> dict[str, Any]:
        """Adam; the category's shapes and joints are a group of their own."""
        category = {"template", "assembly", "axis", "pivot", "confidence"}
        named = dict(self.named_parameters())
        shared = [p for name, p in named.items() if name.removeprefix("articulated.") in category]
        others = [p for name, p in named.items() if name.removeprefix("articulated.") not in category]
        optimizer = torch.optim.Adam(
            [{"params": others}, {"params": shared}], lr=self.schedule.learning_rate, betas=(0.9, 0.999), eps=1e-8
        )
        rates = [self.network_rate, self.category_rate]
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rates)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def network_rate(self, step: int) -> float:
        """Learning rate relative to the initial one, at a step."""
        s = self.schedule
        if self.recipe == "paper":
            return s.decay ** (step // s.decay_every)
        return s.final_rate + (1 - s.final_rate) * 0.5 * (1 + math.cos(math.pi * min(step / s.steps, 1)))

    def category_rate(self, step: int) -> float:
        """The same for category-level shapes and joints: held during the staged recipe's warm-up."""
        if self.recipe == "paper":
            return self.network_rate(step)
        held = step < self.schedule.rigid_steps + self.schedule.warmup_steps
        return 0.0 if held else self.schedule.category_rate * self.network_rate(step)

    def setup(self, stage: str) -> None:
        """Mixed precision, if the trainer asks for it, is for the backbones."""
        mixed = "mixed" in str(self.trainer.precision)
        for network in (self.articulated, self.rigid):
            if network is not None:
                network.mixed_precision = mixed

    def on_train_start(self) -> None:
        """Remember how many points a cloud has."""
        self.num_points = self.trainer.datamodule.hparams.num_points

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """One step of whichever stage the schedule is in; under autocast only the backbones run in low precision."""
        with torch.autocast(self.device.type, enabled=False):
            return self._training_step(split_labels(batch)[0]["points"].float())

    def _training_step(self, points: Tensor) -> Tensor:
        self._track_radius(points)
        if self.global_step < self.schedule.rigid_steps:
            loss = self._rigid_loss(points)
            self.log("loss", loss.detach(), prog_bar=True)
            return loss
        if self.recipe == "paper":
            return self._paper_step(points)
        if self.registered is None:
            self._discover()
        if self.global_step < self.schedule.rigid_steps + self.schedule.warmup_steps:
            return self._warmup_step(len(points))
        return self._staged_step(points)

    @torch.no_grad()
    def _track_radius(self, points: Tensor) -> None:
        radius = (points - points.mean(dim=1, keepdim=True)).norm(dim=-1).mean(dim=1)
        weight = max(0.01, 1 / (self.global_step + 1))
        self.radius_mean.lerp_(radius.mean(), weight)
        self.radius_square.lerp_(radius.square().mean(), weight)

    def _rigid_loss(self, points: Tensor) -> Tensor:
        hypotheses = self.rigid(points)
        posed = hypotheses.posed()
        best = hypothesis_distances(points, posed, bidirectional=not self.objective.unidirectional).argmin(dim=1)
        chosen = posed[torch.arange(len(points), device=points.device), best]
        return chamfer(points, chosen, bidirectional=not self.objective.unidirectional).mean()

    def _paper_step(self, points: Tensor) -> Tensor:
        aligned, _ = self.estimator.align(points)
        losses = []
        for iteration in self.estimator.iterate(aligned):
            selected = iteration.hypotheses.select(iteration.winner)
            terms = paper_terms(selected, aligned, self.objective)
            losses.append(terms.loss)
        self._track(terms, selected)
        return torch.stack(losses).mean()

    def _warmup_step(self, size: int) -> Tensor:
        """Registered clouds turned afresh: poses are known, so the hypothesis nearest to them trains."""
        device = self.device
        generator = torch.Generator().manual_seed(self.global_step * self.trainer.world_size + self.global_rank)
        index = torch.randint(len(self.registered["points"]), (size,), generator=generator)
        rotation = self.orientation.draw(size, generator).to(device)
        points, base, state = (self.registered[name][index].to(device) for name in ("points", "base", "state"))
        if self.orientation.limited:
            rotation = rotation @ base[:, :3, :3].mT  # to an orientation within the range
        turn = se3(rotation, rotation.new_zeros(size, 3))
        aligned, pose = self.estimator.align(transform_points(turn, points))
        base = invert_se3(pose) @ turn @ base
        losses = []
        target = PoseTarget(base, state)
        category = self.articulated.category_object()
        for iteration in self.estimator.iterate(aligned):
            start = torch.eye(3, device=device) if iteration.start is None else iteration.start.base[:, 0, :3, :3]
            nearest = self.group.nearest(start.transpose(-1, -2) @ base[:, :3, :3])
            selected = iteration.hypotheses.select(nearest)
            terms = staged_terms(selected, aligned, category, self.objective, target, follow_category=True)
            losses.append(terms.loss)
        self._track(terms, selected)
        return torch.stack(losses).mean()

    def _staged_step(self, points: Tensor) -> Tensor:
        """Any training cloud: the best reconstruction trains, drawn to where a few rounds of registration move it."""
        aligned, _ = self.estimator.align(points)
        category = self.articulated.category_object()
        losses = []
        for iteration in self.estimator.iterate(aligned):
            winner = iteration.winner
            selected = iteration.hypotheses.select(winner)
            target = None
            if self.objective.distillation:
                start = selected.base[:, 0], selected.state[:, 0], selected.axis[:, 0]
                base, state, after = self.estimator.register(selected, aligned, *start, (0.04, 0.02), 4)
                better = after < iteration.distance.gather(1, winner[:, None])[:, 0]
                target = PoseTarget(
                    torch.where(better[:, None, None], base, start[0].detach()),
                    torch.where(better[:, None], state, start[1].detach()),
                )
            terms = staged_terms(selected, aligned, category, self.objective, target, follow_category=False)
            losses.append(terms.loss)
        self._track(terms, selected)
        return torch.stack(losses).mean()

    @torch.no_grad()
    def _track(self, terms: Terms, selected: Hypotheses) -> None:
        """Log the terms and the warning signs (design 3.5); follow confidences and joint limits."""
        net = self.articulated
        net.mean_confidence.lerp_(selected.confidence.mean(dim=0), max(0.02, 1 / (self.global_step + 1)))
        state = selected.state[:, 0]
        seen = torch.stack([state.amin(dim=0), state.amax(dim=0)], dim=-1)
        self.state_limits.lerp_(seen, 0.02 if self.state_limits.any() else 1.0)
        occupancy = one_hot(terms.association.argmax(dim=-1), self.num_parts).float().mean(dim=(0, 1))
        spread = state.std(dim=0).mean() if len(state) > 1 else state.new_zeros(())
        self.log_dict(
            {
                "loss": terms.loss,
                "rec": terms.reconstruction,
                "reg": terms.joints,
                "distill": terms.distillation,
                "deviation": terms.deviation,
                "seg": terms.segmentation,
                "state_spread": spread.rad2deg() if net.joint_type == REVOLUTE else spread,
                "smallest_part": occupancy.min(),
            },
            prog_bar=True,
        )

    @torch.no_grad()
    def _discover(self) -> None:
        """Part discovery on a fixed subset of the training clouds; the same on every rank."""
        options = self.discovery
        batches = [split_labels(b)[0] for b in self.trainer.datamodule.discovery_dataloader(options.clouds)]
        dense = torch.cat([b["dense_points"] for b in batches]).float()
        with torch.random.fork_rng(devices=[]):
            found = discover(dense, self.num_parts, self.articulated.joint_type, options, self.orientation)
        kept = found.error.argsort()[: max(1, int(options.keep * len(dense)))]
        self.registered = {
            "points": dense[kept, : self.num_points],
            "base": found.base[kept],
            "state": found.state[kept],
        }
        self._adopt(found)

    def _adopt(self, found: ArticulatedTemplate) -> None:
        """Make the discovered template and joints the network's category-level shapes and joints."""
        net, template = self.articulated, found.template
        for part in range(self.num_parts):
            points = template.points[template.label == part].cpu().numpy()
            order = farthest_point_order(points, min(len(points), net.shape_points))
            shape = torch.as_tensor(np.resize(points[order], (net.shape_points, 3)))
            center = shape.mean(dim=0)
            net.assembly.data[part] = center
            net.template.data[part] = shape - center
            net.principal_axes[part] = torch.linalg.eigh((shape - center).T @ (shape - center)).eigenvectors
        chain = found.joints.chain
        pairs = {tuple(p): e for e, p in enumerate(net.pairs.tolist())}
        net.confidence.data.zero_()
        for j, (parent, child) in enumerate(zip(chain.parent, chain.child, strict=True)):
            pair = pairs[min(parent, child), max(parent, child)]
            net.axis.data[pair] = found.joints.axis[j]
            net.pivot.data[pair] = found.joints.pivot[j]
            net.confidence.data[pair] = 2.0
        net.mean_confidence.copy_(net.confidence)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Mark the checkpoint as ours and keep the registered clouds, so that training resumes without discovery."""
        checkpoint[CHECKPOINT_KEY] = {"version": 1, "num_points": self.num_points, "registered": self.registered}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take them back."""
        own = checkpoint[CHECKPOINT_KEY]
        self.num_points, self.registered = own["num_points"], own["registered"]

    # Validation and test

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Reconstruction error of held-out rotations of training clouds; no label is read."""
        points = split_labels(batch)[0]["points"]
        if self.global_step < self.schedule.rigid_steps or (self.recipe == "staged" and self.registered is None):
            return
        error = self.predict_points(points, refine=False).reconstruction_error.mean()
        self.log("val_reconstruction", error, prog_bar=True, batch_size=len(points), sync_dist=True)

    def on_test_start(self) -> None:
        """Relate slots and canonical spaces to the labelled ones, on training clouds."""
        loader = self.trainer.datamodule.calibration_dataloader(self.calibration_samples)
        batches = [self._whole(self.transfer_batch_to_device(batch, self.device, 0)) for batch in loader]
        predictions = [self.predict_points(split_labels(batch)[0]["points"]) for batch in batches]
        self.test_report = TestReport(predictions, batches).to(self.device)

    def test_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Predict, then compare."""
        batch = self._whole(batch)
        start = time.perf_counter()
        prediction = self.predict_points(split_labels(batch)[0]["points"])
        self.test_report.update(prediction, batch, time.perf_counter() - start)

    def _whole(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """The batch with as many points as registration reads; the networks still see those that they would."""
        count = max(batch["points"].shape[1], self.inference.points)
        return batch | {"points": batch["dense_points"][:, :count]}

    def on_test_end(self) -> None:
        """Write metrics.json, metrics.csv and the picture of best, median and worst samples."""
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir)
        data = self.trainer.datamodule
        metrics = self.test_report.metrics.compute()  # on every rank: it gathers
        if self.trainer.is_global_zero:
            self.test_report.write(folder, metrics, data.manifest, str(self.trainer.ckpt_path), self.inference.refine)
