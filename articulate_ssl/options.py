"""Everything a configuration may say about the method, grouped; each default is the paper's where the paper has one."""

from __future__ import annotations

from dataclasses import dataclass, field

from articulate_ssl.recipes.part_discovery import DiscoveryOptions

RECIPES = ("staged", "paper")


@dataclass(frozen=True)
class NetworkOptions:
    """Sizes of the networks.

    Attributes:
        group_order: Rotation group: 12 (tetrahedral), 24 (octahedral) or 60 (icosahedral, the paper's).
        dims: Channels of the backbone's layers.
        radii: Ball radius of each layer, in normalised units.
        num_neighbors: Most neighbours in a ball.
        num_kernel_points: Kernel points, closed under the group.
        num_centers: Points each layer keeps (a farthest-point prefix); null keeps all, as the paper does.
        intra: Follow every convolution by one over the group, as EPN does.
        separable: Depth-wise spatial kernels and a mixing of channels, not full kernels, in all layers but the first.
        directions: Features on the 12 directions of the icosahedron (E2PN) instead of the 60 rotations of its group,
            with separable kernels; part features are read as functions of the rotations again. Needs group_order 60.
        head_dim: Channels of the SO(3)-PointNets and heads.
        shape_points: Points of each canonical part shape.
        flow_bound: Largest per-point displacement of an instance's shape from the category's.
        stretch_bound: Largest log-stretch of a part along its principal axes.
        iterations: Pose estimations per cloud; from the second on, convolution is aware of the estimated poses.
        pose_aware: False leaves every iteration at identity poses (the paper's ablation of pose-aware convolution).
        part_features: False predicts part properties from whole-shape features (the paper's ablation "without parts").
        shared_axis: One axis direction for all joints of an object, as the paper assumes.
    """

    group_order: int = 60
    dims: list[int] = field(default_factory=lambda: [64, 128, 512])
    radii: list[float] = field(default_factory=lambda: [0.08, 0.16, 0.2263])
    num_neighbors: int = 64
    num_kernel_points: int = 24
    num_centers: list[int] | None = None
    intra: bool = False
    separable: bool = False
    directions: bool = False
    head_dim: int = 256
    shape_points: int = 128
    flow_bound: float = 0.1
    stretch_bound: float = 0.3
    iterations: int = 2
    pose_aware: bool = True
    part_features: bool = True
    shared_axis: bool = True


@dataclass(frozen=True)
class ObjectiveOptions:
    """Weights of the objective.

    Attributes:
        unidirectional: Reconstruction distance from the input to the reconstruction only (partial clouds).
        joint_regularization: The paper's lambda; 0 is its ablation of L_reg.
        joint_extent: Half length of the stretch of joint line that L_reg pulls to the parts, in normalised units.
        distillation: Weight of the distance between predicted and registered poses (staged recipe).
        deviation: Weight of the squared distance between an instance's canonical object and joint lines and the
            category's (staged recipe). Without it they drift together with the poses.
        segmentation: Weight of the cross-entropy between part proposal and posterior association (staged recipe).
        posterior_scale: Standard deviation of the posterior association, in normalised units (staged recipe).
    """

    unidirectional: bool = False
    joint_regularization: float = 1.0
    joint_extent: float = 0.1
    distillation: float = 1.0
    deviation: float = 10.0
    segmentation: float = 0.1
    posterior_scale: float = 0.03


@dataclass(frozen=True)
class ScheduleOptions:
    """Steps and learning rates.

    Attributes:
        steps: Length of the schedule; the trainer's `max_steps` says when to stop.
        rigid_steps: Steps of stage 0, rigid alignment of the whole shape, before the articulated network trains.
        warmup_steps: Steps on registered clouds alone, with the category's shapes and joints held (staged recipe).
        learning_rate: Of Adam.
        decay: The learning rate is multiplied by this every `decay_every` steps (paper recipe).
        decay_every: See above.
        final_rate: Share of the learning rate that is left at the end of its cosine (staged recipe).
        category_rate: Learning rate of category-level shapes and joints relative to the networks' (staged recipe).
    """

    steps: int = 10_000
    rigid_steps: int = 0
    warmup_steps: int = 4_000
    learning_rate: float = 1e-4
    decay: float = 0.7
    decay_every: int = 1000
    final_rate: float = 0.02
    category_rate: float = 0.1


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


__all__ = ["RECIPES", "DiscoveryOptions", "InferenceOptions", "NetworkOptions", "ObjectiveOptions", "ScheduleOptions"]
