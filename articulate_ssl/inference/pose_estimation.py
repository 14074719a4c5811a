"""From clouds to articulated poses: aligned, hypothesised over the group, iterated, chosen, and registered.

1. *Alignment* (stage 0): the rigid network turns the whole cloud to roughly canonical orientation.
2. *Iteration*: the articulated network gives a hypothesis per group element; from the second pass on it reads the
   cloud in the part frames of the last winner (paper, Sec. 3.1).
3. *Registration* at test time: the leading hypotheses' predicted shapes are registered to the cloud without leaving
   their joints, and the best reconstruction wins.

Training takes the first two steps too; nothing here knows a loss or an optimiser.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.confidence import relative_error
from articulate_ssl.inference.point_cloud_io import normalise_cloud
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.losses.reconstruction import distances_to_parts
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.chamfer import chamfer, hypothesis_distances
from articulate_ssl.shape.observation import Observation

_ANOTHER_WAY = math.radians(30)  # beyond, one of two hypotheses is wrong (`metrics.above_30_rate`)
# Standard deviations, over the training clouds, by which the scale of a scan may differ from their mean.
_SCALE_STARTS = (-1.5, -0.75, 0.0, 0.75, 1.5)


@dataclass(frozen=True)
class InferenceOptions:
    """What happens at test time after the network.

    Attributes:
        refine: Register the predicted shape to the cloud from the best hypotheses.
        points: Most points of a cloud that registration reads and labels (a farthest-point prefix). Which way up a
            closed laptop is shows in less than the spacing of the few points that suffice for the networks.
        candidates: Hypotheses that are refined; the best reconstruction wins.
        rounds: Rounds of registration.
        coarse_scale: First standard deviation of the correspondences, in normalised units.
        fine_scale: Last one.
    """

    refine: bool = True
    points: int = 512
    candidates: int = 4
    rounds: int = 8
    coarse_scale: float = 0.05
    fine_scale: float = 0.02


def rivals(
    error: Tensor,  # [B, C] of the hypotheses
    base: Tensor,  # [B, C, 4, 4]
    chosen: Tensor,  # [B]
    allowed: Tensor,  # [B, C] bool, which ones may be rivals
) -> tuple[Tensor, Tensor]:  # [B], [B]
    """Rivals of chosen hypotheses, the best ones that are turned another way, and `Prediction.margin`.

    Where none is turned another way, the chosen one is its own rival, and the margin 1.
    """
    rows = torch.arange(len(chosen), device=chosen.device)
    rotation = base[..., :3, :3]
    angle = roma.rotmat_geodesic_distance(rotation, rotation[rows, chosen, None].expand_as(rotation))
    least, rival = error.masked_fill(~allowed | (angle < _ANOTHER_WAY), torch.inf).min(dim=1)
    return torch.where(least.isinf(), chosen, rival), (1 - error[rows, chosen] / least).clamp(0, 1)


@dataclass(frozen=True)
class Iteration:
    """One pose estimation of clouds.

    Attributes:
        points: [B, N, 3] the clouds, aligned.
        hypotheses: One per group element.
        start: The estimate that the hypotheses are residuals to (the winner of the iteration before), or None.
        observation: How hypotheses are compared; those that are turned too far are the last to be chosen.
    """

    points: Tensor
    hypotheses: Hypotheses
    start: Hypotheses | None
    observation: Observation

    @cached_property
    @torch.no_grad()
    def distance(self) -> Tensor:
        """d(X, Y^g) of every hypothesis, [B, G], without gradient."""
        posed = self.hypotheses.posed().flatten(2, 3)
        return hypothesis_distances(self.points, posed, bidirectional=self.observation.bidirectional)

    @property
    def winner(self) -> Tensor:
        """argmin_g d(X, Y^g), [B]."""
        return self.leading(1)[:, 0]

    def leading(self, count: int) -> Tensor:
        """The hypotheses of the smallest d(X, Y^g), best first, [B, count]."""
        ranked = self.observation.ranked(self.distance, self.hypotheses.base[..., :3, :3])
        return ranked.topk(count, largest=False).indices


class PoseEstimator:
    """Pose estimation with the networks of a module, which owns them, trains them and saves them.

    Args:
        articulated: The articulated network.
        rigid: Stage 0's network, or None where clouds are taken as they come.
        iterations: Pose estimations per cloud.
        observation: How clouds are taken.
        posterior_scale: Standard deviation of the association of points with posed parts, in normalised units.
        inference: Registration at test time.
    """

    def __init__(
        self,
        articulated: ArticulatedNetwork,
        rigid: RigidAlignment | None,
        iterations: int,
        observation: Observation,
        posterior_scale: float,
        inference: InferenceOptions,
    ) -> None:
        self.articulated, self.rigid, self.iterations = articulated, rigid, iterations
        self.observation, self.posterior_scale, self.inference = observation, posterior_scale, inference

    def align(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Stage 0: clouds turned roughly to canonical orientation [B, N, 3], and the pose [B, 4, 4] that undoes it."""
        if self.rigid is None:
            return points, torch.eye(4).to(points).expand(len(points), 4, 4)
        with torch.no_grad():
            hypotheses = self.rigid(points)
            distance = hypothesis_distances(points, hypotheses.posed(), bidirectional=self.observation.bidirectional)
            best = distance.argmin(dim=1)
            rows = torch.arange(len(points), device=points.device)
            pose = se3(hypotheses.rotation[rows, best], hypotheses.translation[rows, best])
        return transform_points(invert_se3(pose), points), pose

    def iterate(
        self,
        points: Tensor,  # [B, N, 3] aligned
    ) -> Iterator[Iteration]:
        """Pose estimations, each from the winner of the one before."""
        start, labels = None, None
        for number in range(self.iterations):
            hypotheses = self.articulated(points, start, labels)
            iteration = Iteration(points, hypotheses, start, self.observation)
            yield iteration
            if number + 1 < self.iterations:
                start = hypotheses.select(iteration.winner)
                labels = distances_to_parts(points, start.posed()[:, 0]).argmin(dim=-1)

    @torch.no_grad()
    def register(
        self,
        candidates: Hypotheses,  # H of each cloud: where to start, and what is registered
        points: Tensor,  # [B, N, 3]
        scales: tuple[float, float],
        rounds: int,
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, H, 4, 4], [B, H, J], [B, H]
        """Register the predicted shapes to the clouds (`register_articulated`): base poses, joint states, errors."""
        count = candidates.base.shape[1]
        registered = register_articulated(
            candidates.articulated_shape(),
            points.repeat_interleave(count, dim=0),
            candidates.base.flatten(0, 1),
            candidates.state.flatten(0, 1),
            scales,
            rounds,
            self.observation.bidirectional,
        )
        return tuple(value.unflatten(0, (-1, count)) for value in registered)

    @torch.no_grad()
    def predict(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        refine: bool | None = None,
    ) -> Prediction:
        """Predictions for whole clouds; one cloud's does not depend on the rest of the batch.

        Args:
            num_points: The networks read this many leading points; registration reads all.
            refine: Register at test time, or not; None does what the options say.

        Raises:
            ValueError: if a cloud has NaN or infinite points.
        """
        return self.predict_with_rivals(points, num_points, refine)[0]

    @torch.no_grad()
    def predict_with_rivals(
        self,
        points: Tensor,  # [B, N, 3] normalised, farthest-point order
        num_points: int,
        refine: bool | None = None,
    ) -> tuple[Prediction, Prediction]:
        """`predict`, and of every cloud the best hypothesis that is turned another way (the same, if none is).

        Raises:
            ValueError: if a cloud has NaN or infinite points.
        """
        if not torch.isfinite(points).all():
            raise ValueError("a cloud has NaN or infinite points")
        with torch.autocast(points.device.type, enabled=False):
            aligned, pose = self.align(points[:, :num_points])
            *_, last = self.iterate(aligned)
            if self.inference.refine if refine is None else refine:
                candidates, error = self._refine(last, transform_points(invert_se3(pose), points))
            else:
                candidates, error = last.hypotheses, last.distance
            candidates = candidates.at(pose[:, None] @ candidates.base, candidates.state)
            rotation = candidates.base[..., :3, :3]
            best = self.observation.ranked(error, rotation).argmin(dim=1)
            rival, margin = rivals(error, candidates.base, best, self.observation.orientation.contains(rotation))
            chosen = self._prediction(candidates.select(best), points, margin)
            return chosen, self._prediction(candidates.select(rival), points, torch.zeros_like(margin))

    def predict_scan(
        self,
        points: np.ndarray,  # [N, 3] any unit and origin
        num_points: int,
        radius: tuple[float, float],
        refine: bool | None = None,
    ) -> ScanEstimate:
        """Predict a scan of unknown scale: of several within the training clouds' range, the best reconstruction wins.

        Args:
            num_points: See `predict`; registration reads as many as the options say.
            radius: Mean and standard deviation, over normalised training clouds, of the points' mean distance to their
                centre.
        """
        cloud, center, _ = normalise_cloud(points, max(num_points, self.inference.points), scale=1.0)
        mean, spread = radius
        size = float(np.linalg.norm(np.asarray(points, dtype=np.float64) - center, axis=1).mean())
        scales = [size / (mean + shift * spread) for shift in _SCALE_STARTS]
        device = self.articulated.category.template.device
        batch = torch.stack([torch.as_tensor(cloud / scale, dtype=torch.float32) for scale in scales]).to(device)
        prediction, rival = self.predict_with_rivals(batch, num_points, refine)
        best = int(relative_error(prediction, batch).argmin())
        one = slice(best, best + 1)
        rival = rival[one] if prediction.margin[best] < 1 else None
        return ScanEstimate(prediction[one], rival, batch[best].cpu().numpy(), center, scales[best])

    def _refine(self, last: Iteration, points: Tensor) -> tuple[Hypotheses, Tensor]:
        """The leading hypotheses after articulated registration of the predicted shape, and their errors."""
        options, hypotheses = self.inference, last.hypotheses
        count = min(options.candidates, hypotheses.base.shape[1])
        candidates = hypotheses.select(last.leading(count))
        scales = options.coarse_scale, options.fine_scale
        base, state, error = self.register(candidates, points, scales, options.rounds)
        return candidates.at(base, state), error

    def _prediction(self, chosen: Hypotheses, points: Tensor, margin: Tensor) -> Prediction:
        """Package one hypothesis per cloud."""
        pose = chosen.object_pose()[:, 0]
        part_pose = pose.clone()
        part_pose[..., :3, 3] = transform_points(pose, chosen.assembly[:, :, None])[:, :, 0]
        chain = chosen.chain
        parent = torch.tensor(chain.parent, device=points.device)
        posed = chosen.posed()[:, 0]
        to_part = distances_to_parts(points, posed)
        shape = (len(points), len(parent))
        axis, pivot = chosen.axis[:, 0], chosen.pivot
        parent_pose = pose[:, parent]
        return Prediction(
            part_id=to_part.argmin(dim=-1),
            part_probability=(to_part.square() / (-2 * self.posterior_scale**2)).softmax(dim=-1),
            part_pose=part_pose,
            part_shape=chosen.part_shape,
            assembly=chosen.assembly,
            base_pose=chosen.base[:, 0],
            joint_parent=parent.expand(shape),
            joint_child=torch.tensor(chain.child, device=points.device).expand(shape),
            joint_type=torch.full(shape, chosen.structure.joint_type, device=points.device),
            joint_axis=(parent_pose[..., :3, :3] @ axis[..., None]).squeeze(-1),
            joint_pivot=transform_points(parent_pose, pivot[:, :, None])[:, :, 0],
            joint_state=chosen.state[:, 0],
            canonical_axis=axis,
            canonical_pivot=pivot,
            reconstruction_error=chamfer(points, posed.flatten(1, 2), bidirectional=self.observation.bidirectional),
            margin=margin,
        )
