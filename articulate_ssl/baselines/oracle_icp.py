"""Oracle ICP, the paper's baseline: ground-truth parts, each registered with ICP to parts of five training shapes.

Paper, appendix "Oracle ICP". What it leaves open is decided here: point-to-point ICP; correspondences up to
`Options.correspondence_distance`; the same five templates for every test cloud; templates at rest; on partial clouds a
template is the union of several training views of its instance, and the ten initial translations are the observed
centroid and nine Gaussian offsets from it. A hypothesis without any correspondence never wins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.baselines.method import (
    PART_LABELS,
    PART_POSES,
    POSES,
    SEGMENTATION,
    TEST_PARTS,
    Effort,
    Method,
    Problem,
    no_joints,
)
from articulate_ssl.baselines.perfect_oracle import part_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import nearest_index
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import ArticulatedDataset

registration = o3d.pipelines.registration
SCREEN_ITERATIONS = 5
SCREEN_POINTS = 48


@dataclass(frozen=True)
class Options:
    """How Oracle ICP runs.

    Attributes:
        initial_rotations: Size of the rotation group that initial rotations come from (paper: 60).
        initial_translations: 1 for complete clouds (paper).
        partial_translations: The same for partial clouds (paper: 10).
        translation_std: Standard deviation of the offsets of all initial translations but the first.
        correspondence_distance: Largest distance of corresponding points, in cloud units.
        iterations: ICP iterations at most.
        templates: Training instances that are registered (paper: 5).
        template_views: Most views of partial clouds that a template is the union of.
        template_points: Points of every template part.
        screen: Not in the paper. If set, all hypotheses first run with few points and iterations (`SCREEN_POINTS`,
            `SCREEN_ITERATIONS`), and only this many, those with the smallest inlier RMSE, run in full.
        partial_screen: The same for partial clouds, ten times as much work.
        seed: Of templates, point subsets and initial translations.
    """

    initial_rotations: int = 60
    initial_translations: int = 1
    partial_translations: int = 10
    translation_std: float = 0.1
    correspondence_distance: float = 0.2
    iterations: int = 30
    templates: int = 5
    template_views: int = 10
    template_points: int = 256
    screen: int | None = None
    partial_screen: int | None = 60
    seed: int = 0


def make_template(
    labels: dict[str, Tensor],
    options: Options,
) -> Tensor:  # [K, M, 3]
    """Parts of one instance in V views, moved back to rest: the object's axes, about each part's bounding-box centre.

    Args:
        labels: shard arrays of V clouds of the same instance; views of unequal `scale` are brought to their mean.
    """
    generator = torch.Generator().manual_seed(options.seed)
    size = labels["scale"][:, None, None] / labels["scale"].mean()
    parts = []
    for k in range(labels["part_pose"].shape[1]):
        rest = transform_points(invert_se3(labels["part_pose"][:, k]), labels["dense_points"])
        centred = (rest - labels["part_center"][:, k, None]) * size  # [V, P, 3]
        points, part_id = centred.flatten(0, 1), labels["dense_part_id"].flatten()
        order = torch.randperm(len(points), generator=generator)
        parts.append(part_points(points[order], part_id[order], k, options.template_points, points.new_zeros(3)))
    return torch.stack(parts)


def point_cloud(points: Tensor) -> o3d.geometry.PointCloud:
    """[N, 3] as Open3D's type."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.double().numpy()))


def initial_poses(
    template: Tensor,  # [M, 3]
    observed: Tensor,  # [N, 3]
    options: Options,
) -> Tensor:  # [H, 4, 4] float64
    """Every initial rotation with every initial translation; the first translation brings the centroids together."""
    rotation = rotation_group(options.initial_rotations).elements.double()
    generator = torch.Generator().manual_seed(options.seed)
    offset = torch.randn(options.initial_translations, 3, generator=generator, dtype=torch.float64)
    offset = offset * options.translation_std
    offset[0] = 0.0
    centred = observed.double().mean(0) - rotation @ template.double().mean(0)  # [G, 3]
    return se3(rotation[:, None], centred[:, None] + offset).flatten(0, 1)


def register_part(
    template: Tensor,  # [M, 3]
    observed: Tensor,  # [N, 3]
    options: Options,
) -> tuple[np.ndarray, float]:  # [4, 4], inlier RMSE
    """Best pose of a template part over all initial poses; infinite error if nothing ever corresponded."""
    target = point_cloud(observed)

    def icp(source: o3d.geometry.PointCloud, pose: np.ndarray, iterations: int) -> tuple[float, np.ndarray]:
        result = registration.registration_icp(
            source,
            target,
            options.correspondence_distance,
            pose,
            registration.TransformationEstimationPointToPoint(),
            registration.ICPConvergenceCriteria(max_iteration=iterations),
        )
        # Open3D gives RMSE 0 to a registration without correspondences.
        rmse = result.inlier_rmse if len(result.correspondence_set) else np.inf
        return rmse, result.transformation

    poses = list(initial_poses(template, observed, options).numpy())
    if options.screen is not None:
        few = point_cloud(template[:SCREEN_POINTS])
        order = np.argsort([icp(few, pose, SCREEN_ITERATIONS)[0] for pose in poses], kind="stable")
        poses = [poses[i] for i in order[: options.screen]]
    full = point_cloud(template)
    rmse, pose = min((icp(full, pose, options.iterations) for pose in poses), key=lambda r: r[0])
    return pose, rmse


class OracleICP(Method):
    """Part poses by registration of ground-truth parts to parts of training shapes; nothing is said about joints.

    Canonical part spaces are the perfect oracle's: labelled axes, and the bounding-box centre of the winning template's
    part as origin. A part that was not observed at all is put on the cloud's centroid, unrotated.

    Args:
        problem: What is known of the category.
        options: How it runs; on partial clouds with `partial_translations` initial translations.
    """

    title = "Oracle ICP"
    given = (PART_LABELS, PART_POSES, TEST_PARTS)
    says = (SEGMENTATION, POSES)
    effort = Effort(steps=0, batch_size=16, learning_rate=0.0)
    labelled_spaces = True

    def __init__(self, problem: Problem, options: Options = Options()) -> None:
        super().__init__(problem)
        self.options = options
        self.register_buffer("templates", torch.zeros(0, problem.num_parts, options.template_points, 3))
        self.register_buffer("partial", torch.tensor(False))

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        """Templates of randomly chosen training instances."""
        train = ArticulatedDataset(data.folder, "train", num_points=self.problem.num_points)
        self.partial = torch.tensor(data.hparams.view == "partial")
        views = self.options.template_views if self.partial else 1
        chosen = choose_views(train.labels["instance"], self.options.templates, views, seed)
        self.templates = torch.stack([make_template(train.__getitems__(v.tolist()), self.options) for v in chosen])

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """The best of all templates for each part; every point takes the part that is nearest to it then."""
        points = batch["points"].cpu()
        nearest = nearest_index(points, batch["dense_points"].cpu())[1]
        part_id = batch["dense_part_id"].cpu().long().gather(1, nearest)
        options = self.options
        if self.partial:
            options = replace(options, initial_translations=options.partial_translations, screen=options.partial_screen)
        pose, shape = register_parts(points, part_id, self.templates.cpu(), options)
        posed = transform_points(pose, shape)  # [B, K, M, 3]
        parts = range(self.problem.num_parts)
        distance = torch.stack([nearest_index(points, posed[:, k])[0] for k in parts], dim=-1)  # [B, N, K]
        part_id = distance.argmin(-1)
        return Prediction(
            part_id=part_id,
            part_probability=one_hot(part_id, self.problem.num_parts).to(points.dtype),
            part_pose=pose,
            part_shape=shape,
            assembly=torch.zeros_like(pose[..., :3, 3]),
            base_pose=pose[:, 0],
            reconstruction_error=distance.amin(-1).mean(-1).to(points.dtype),
            margin=points.new_ones(len(points)),
            **no_joints(points),
        )


def register_parts(
    points: Tensor,  # [B, N, 3]
    part_id: Tensor,  # [B, N] true part of every point
    templates: Tensor,  # [T, K, M, 3]
    options: Options,
) -> tuple[Tensor, Tensor]:  # [B, K, 4, 4], [B, K, M, 3]
    """Pose and shape of the template that fits each part of each cloud best; see `OracleICP` for unobserved parts."""
    clouds, num_parts = len(points), templates.shape[1]
    pose = torch.eye(4, dtype=points.dtype).repeat(clouds, num_parts, 1, 1)
    pose[..., :3, 3] = points.mean(1)[:, None]
    shape = templates[0].repeat(clouds, 1, 1, 1)
    for b in range(clouds):
        for k in range(num_parts):
            observed = points[b][part_id[b] == k]
            if len(observed) == 0:
                continue
            results = [(*register_part(template, observed, options), template) for template in templates[:, k]]
            best, _, shape[b, k] = min(results, key=lambda result: result[1])
            pose[b, k] = torch.from_numpy(best.copy())
    return pose, shape


def choose_views(
    instance: np.ndarray,  # [S]
    templates: int,
    views: int,
    seed: int,
) -> list[np.ndarray]:
    """Sample indices of up to `views` clouds of each of `templates` randomly chosen instances."""
    generator = np.random.default_rng(seed)
    available = np.unique(instance)
    chosen = generator.choice(available, size=min(templates, len(available)), replace=False)
    members = [np.flatnonzero(instance == i) for i in chosen]
    return [generator.choice(m, size=min(views, len(m)), replace=False) for m in members]
