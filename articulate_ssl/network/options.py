"""Sizes of the networks; each default is the paper's where the paper has one."""

from __future__ import annotations

from dataclasses import dataclass, field

from articulate_ssl.ops.options import require_at_least


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
        state_anchors: Joint states that hypotheses start from, beside rotations: the middles of so many equal stretches
            of the articulation range, for several joints in every combination. 1 is the middle of the range, as in the
            original code; 0 lets all start at zero, where an axis and its pivot have no gradient; null leaves it to the
            recipe (0 staged; paper: as many as make at most `recipes.paper.STATE_COMBINATIONS` combinations).
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
    state_anchors: int | None = None

    def __post_init__(self) -> None:
        """Raises: ValueError for sizes of which there is no network."""
        counts = ("dims", "num_neighbors", "num_kernel_points", "head_dim", "shape_points", "iterations")
        require_at_least(self, "network.", **dict.fromkeys(counts, 1))
        if not all(radius > 0 for radius in self.radii):
            raise ValueError(f"network.radii are {self.radii}, must be larger than 0")
