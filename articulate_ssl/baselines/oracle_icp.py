"""Oracle ICP, the paper's baseline: ground-truth parts, each registered with ICP to parts of five training shapes.

Paper, appendix "Oracle ICP". What it leaves open is decided here: point-to-point ICP; correspondences up to
`Options.correspondence_distance`; the same five templates for every test cloud; templates at rest; on partial clouds a
template is the union of several training views of its instance, and the ten initial translations are the observed
centroid and nine Gaussian offsets from it. A hypothesis without any correspondence never wins.

    python -m articulate_ssl.baselines.oracle_icp --root data --category laptop --samples 64
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.baselines.perfect_oracle import part_points, perfect_oracle
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.functional import nearest_index
from articulate_ssl.metrics.report import write_report
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
        initial_translations: 1 for complete clouds, 10 for partial ones (paper).
        translation_std: Standard deviation of the offsets of all initial translations but the first.
        correspondence_distance: Largest distance of corresponding points, in cloud units.
        iterations: ICP iterations at most.
        template_points: Points of every template part.
        screen: Not in the paper. If set, all hypotheses first run with few points and iterations (`SCREEN_POINTS`,
            `SCREEN_ITERATIONS`), and only this many, those with the smallest inlier RMSE, run in full.
        seed: Of templates, point subsets and initial translations.
    """

    initial_rotations: int = 60
    initial_translations: int = 1
    translation_std: float = 0.1
    correspondence_distance: float = 0.2
    iterations: int = 30
    template_points: int = 256
    screen: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Template:
    """A training shape by parts.

    Attributes:
        parts: [K, M, 3] points of every part at rest, relative to the part's bounding-box centre, in the object's axes.
    """

    parts: Tensor


def make_template(
    labels: dict[str, Tensor],
    options: Options,
) -> Template:
    """Union of V views of one instance, every part moved back to rest.

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
    return Template(torch.stack(parts))


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


def oracle_icp(
    labels: dict[str, Tensor],
    templates: Sequence[Template],
    options: Options,
) -> Prediction:
    """Part poses by registration of ground-truth parts; ICP predicts no joints, so the prediction has none (J = 0).

    Canonical part spaces are the perfect oracle's, so both share one calibration: labelled axes, and the bounding-box
    centre of the winning template's part as origin. A part that was not observed at all is put on the cloud's centroid,
    unrotated.

    Args:
        labels: shard arrays of B test clouds; of these `points`, and the true part of every point.
        templates: shapes to register.
        options: how.
    """
    truth = perfect_oracle(labels)
    points, num_parts = labels["points"], truth.num_parts
    pose, shape = register_parts(points, truth.part_id, templates, options)
    posed = transform_points(pose, shape)  # [B, K, M, 3]
    distance = torch.stack([nearest_index(points, posed[:, k])[0] for k in range(num_parts)], dim=-1)  # [B, N, K]
    part_id = distance.argmin(-1)
    return replace(
        truth,
        part_id=part_id,
        part_probability=one_hot(part_id, num_parts).to(points.dtype),
        part_pose=pose,
        part_shape=shape,
        base_pose=pose[:, 0],
        reconstruction_error=distance.amin(-1).mean(-1).to(points.dtype),
        **_no_joints(points),
    )


def register_parts(
    points: Tensor,  # [B, N, 3]
    part_id: Tensor,  # [B, N] true part of every point
    templates: Sequence[Template],
    options: Options,
) -> tuple[Tensor, Tensor]:  # [B, K, 4, 4], [B, K, M, 3]
    """Pose and shape of the template that fits each part of each cloud best; see `oracle_icp` for unobserved parts."""
    clouds, num_parts = len(points), len(templates[0].parts)
    pose = torch.eye(4, dtype=points.dtype).repeat(clouds, num_parts, 1, 1)
    pose[..., :3, 3] = points.mean(1)[:, None]
    shape = torch.stack([templates[0].parts] * clouds)
    for b in range(clouds):
        for k in range(num_parts):
            observed = points[b][part_id[b] == k]
            if len(observed) == 0:
                continue
            results = [(*register_part(t.parts[k], observed, options), t) for t in templates]
            best, _, template = min(results, key=lambda r: r[1])
            pose[b, k] = torch.from_numpy(best.copy())
            shape[b, k] = template.parts[k]
    return pose, shape


def _no_joints(points: Tensor) -> dict[str, Tensor]:
    """Every joint field of a prediction for clouds [B, N, 3], with J = 0."""
    none = points.new_zeros(len(points), 0)
    index = torch.zeros(len(points), 0, dtype=torch.long)
    vector = none[..., None].expand(-1, -1, 3)
    return {
        "joint_parent": index,
        "joint_child": index,
        "joint_type": index,
        "joint_axis": vector,
        "joint_pivot": vector,
        "joint_state": none,
        "canonical_axis": vector,
        "canonical_pivot": vector,
    }


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


def _score(
    data: ArticulatedDataModule,
    train: ArticulatedDataset,
    templates: Sequence[Template],
    options: Options,
) -> tuple[dict, float]:
    """Metrics over the test clouds, calibrated on training clouds; and the seconds that all predictions took."""
    labels = train.__getitems__(np.linspace(0, len(train) - 1, min(len(train), 128)).astype(int).tolist())
    metrics = ArticulatedPoseMetrics(calibrate(perfect_oracle(labels), labels))
    seconds = 0.0
    for batch in data.test_dataloader():
        start = time.perf_counter()
        prediction = oracle_icp(batch, templates, options)
        seconds += time.perf_counter() - start
        metrics.update(prediction, batch)
    return metrics.compute(), seconds


def main(arguments: Sequence[str] | None = None) -> None:
    """Run Oracle ICP on the test split of a generated set and report it like a network."""
    parser = _parser()
    args = parser.parse_args(arguments)
    partial = args.view == "partial"
    protocol = args.protocol or "honest" if partial else None
    try:
        data, train = _open_data(args, protocol)
    except ValueError as error:
        parser.error(str(error))
    options = Options(
        initial_translations=10 if partial else 1,
        correspondence_distance=args.distance,
        screen=args.screen,
        seed=args.seed,
    )
    views = choose_views(train.labels["instance"], args.templates, args.template_views if partial else 1, args.seed)
    templates = [make_template(train.__getitems__(v.tolist()), options) for v in views]
    result, seconds = _score(data, train, templates, options)
    write_report(
        args.out,
        result,
        category=args.category,
        source=args.source,
        protocol=protocol or "complete",
        checkpoint=None,
        seconds_per_cloud=seconds / result["samples"],
        method="Oracle ICP",
        screen=args.screen,
        part_names=list(data.manifest.part_names),
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m articulate_ssl.baselines.oracle_icp", description=main.__doc__)
    parser.add_argument("--root", default="data", help="folder that `make data` wrote to")
    parser.add_argument("--category", required=True)
    parser.add_argument("--source", default="procedural")
    parser.add_argument("--view", default="complete", choices=("complete", "partial"))
    parser.add_argument("--protocol", default=None, choices=("honest", "eap"))
    parser.add_argument("--samples", type=int, default=64, help="test clouds, spread over instances and states")
    parser.add_argument("--points", type=int, default=512, help="points per cloud")
    parser.add_argument("--templates", type=int, default=5)
    parser.add_argument("--template-views", type=int, default=10, help="views per template of partial clouds")
    parser.add_argument("--distance", type=float, default=Options.correspondence_distance)
    parser.add_argument("--screen", type=int, default=None, help="not in the paper: refine only so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("build/oracle_icp"), help="folder of the report")
    return parser


def _open_data(args: argparse.Namespace, protocol: str | None) -> tuple[ArticulatedDataModule, ArticulatedDataset]:
    """The test clouds, and the training clouds of the same set."""
    data = ArticulatedDataModule(
        args.category,
        args.root,
        args.source,
        args.view,
        protocol,
        num_points=args.points,
        batch_size=8,
        max_test_samples=args.samples,
    )
    data.setup("test")
    return data, ArticulatedDataset(data.folder, "train", num_points=args.points)


if __name__ == "__main__":
    main()
