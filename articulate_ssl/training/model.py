"""The model: owns networks, everything learnt after training, and their options; predicts. It knows no Lightning.

To predict, Lightning would have to be imported for nothing, which takes seconds; `training/module.py` trains it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.inference.confidence import Confidence, relative_error
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.inference.scan_scales import predict_scans
from articulate_ssl.inference.standing_part import StandingPart
from articulate_ssl.losses.objective import ObjectiveOptions
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.options import require_at_least
from articulate_ssl.shape.observation import Observation
from articulate_ssl.training.recipes import recipe_class
from articulate_ssl.training.running_statistics import RadiusStatistics
from articulate_ssl.training.schedule import ScheduleOptions

JOINT_TYPES = {"revolute": REVOLUTE, "prismatic": PRISMATIC}


class ArticulatedPoseModel(nn.Module):
    """Articulated objects of one category: networks, what they and the category have learnt, and predictions by it.

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
        view_looks_samples: Views of scans, most of them with doors nearly closed, by which a network learns which way
            round boxes look in views (`inference.other_views`); 10 minutes. 0 learns none.
        alike_boxes_samples: Training clouds of boxes with doors that are kept, as predicted, and say how others are
            turned that are like them (`inference.alike_boxes`); 10 minutes to register them. 0 keeps none.
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
        view_looks_samples: int = 2400,
        alike_boxes_samples: int = 512,
        box_turns_samples: int = 640,
        orientation_range: float = 180.0,
    ) -> None:
        super().__init__()
        options = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        observation = Observation(OrientationRange(orientation_range), objective.unidirectional)
        _check(num_parts, joint_type, state_range, observation, schedule)
        self.options = {name: _plain(value) for name, value in options.items()}
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
        self.alike_boxes_samples = alike_boxes_samples
        self.closed_views_samples, self.view_looks_samples = closed_views_samples, view_looks_samples
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
        self.closed_views, self.closed_plates = self.estimator.closed_views, self.estimator.closed_plates
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

    def restore(self, kept: dict[str, Any]) -> None:
        """Take back what a checkpoint keeps beside parameters and options."""
        self.num_points = kept["num_points"]
        self.recipe.restore(kept["recipe"])


def _plain(value: Any) -> Any:
    """An option as a checkpoint may hold it."""
    return asdict(value) if is_dataclass(value) else value


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
