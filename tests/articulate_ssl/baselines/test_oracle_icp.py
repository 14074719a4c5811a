import json
from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.__main__ import main
from articulate_ssl.baselines.method import Problem
from articulate_ssl.baselines.oracle_icp import (
    Options,
    OracleICP,
    choose_views,
    initial_poses,
    make_template,
    register_part,
)
from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.baselines.runner import seen_in_test
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from datamodules.articulated_dataset import ArticulatedDataset

FEW = Options(initial_rotations=12, template_points=96)


def wedge(count: int = 96) -> torch.Tensor:
    """Points of a solid without symmetry, about its bounding-box centre."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([0.5, 0.3, 0.15])
    points[:, 2] *= points[:, 0] / 0.5
    points[:, 1] *= 0.3 + points[:, 0]
    return points - (points.amax(0) + points.amin(0)) / 2


def test_registration_recovers_a_motion():
    torch.manual_seed(0)
    template = wedge()
    motion = se3(roma.random_rotmat(), torch.tensor([0.3, -0.2, 1.0]))
    pose, rmse = register_part(template, transform_points(motion, template), replace(FEW, initial_rotations=60))
    assert rmse < 1e-4
    np.testing.assert_allclose(pose, motion.numpy(), atol=1e-3)


def test_screening_finds_the_same_motion():
    torch.manual_seed(1)
    template = wedge()
    motion = se3(roma.random_rotmat(), torch.tensor([0.3, -0.2, 1.0]))
    observed = transform_points(motion, template)
    options = replace(FEW, initial_rotations=60, screen=10)
    np.testing.assert_allclose(register_part(template, observed, options)[0], motion.numpy(), atol=1e-3)


def test_no_correspondence_never_wins():
    """Open3D says RMSE 0 where nothing corresponds."""
    observed = torch.tensor([[0.0, 0, 0], [5.0, 0, 0]])  # the centroid is far from both points
    _, rmse = register_part(wedge(), observed, FEW)
    assert rmse == np.inf


def test_initial_poses_bring_centroids_together():
    template, observed = wedge() + 1.0, wedge() - 2.0
    poses = initial_poses(template, observed, replace(FEW, initial_rotations=60, initial_translations=10))
    assert poses.shape == (600, 4, 4)
    first = transform_points(poses.view(60, 10, 4, 4)[:, 0], template.double()).mean(1)
    torch.testing.assert_close(first, observed.double().mean(0).expand(60, 3), atol=1e-6, rtol=0)
    assert len({tuple(np.round(p, 6)) for p in poses[:10, :3, 3].tolist()}) == 10


def test_template_of_several_views_is_the_part_at_rest(tmp_path):
    folder = write_synthetic_set(tmp_path, view="partial", protocol="honest")
    train = ArticulatedDataset(folder, "train", num_points=128)
    labels = train.__getitems__(choose_views(train.labels["instance"], 1, 4, seed=0)[0].tolist())
    parts = make_template(labels, FEW)
    assert parts.shape == (2, 96, 3)
    # Points fill each part's box, whose centre is the origin of the template.
    assert parts.amax(1).add(parts.amin(1)).abs().max() < 0.1


def test_choice_of_templates_is_seeded_and_takes_distinct_instances():
    instance = np.repeat(np.arange(8), 5)
    first, again = (choose_views(instance, 5, 3, seed=1) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert len({int(instance[v[0]]) for v in first}) == 5
    assert all(len(set(v.tolist())) == 3 and len(set(instance[v])) == 1 for v in first)
    assert len(choose_views(instance, 20, 3, seed=1)) == 8


def wedge_labels(clouds: int = 3) -> dict[str, torch.Tensor]:
    """Two wedges on a prismatic joint."""
    torch.manual_seed(0)
    center = torch.tensor([[0.0, 0, 0], [0.0, 0.5, 0]]).expand(clouds, 2, 3)
    part_pose = se3(roma.random_rotmat(clouds), torch.randn(clouds, 3))[:, None].expand(clouds, 2, 4, 4)
    parts = transform_points(part_pose, wedge() + center[:, :, None])  # [B, 2, 96, 3]
    points = parts.transpose(1, 2).flatten(1, 2)  # parts in turn
    part_id = torch.arange(192).remainder(2).expand(clouds, 192)
    axis = part_pose[:, :1, :3, 1]
    joint = torch.zeros(clouds, 1, dtype=torch.long)
    return {
        "points": points,
        "dense_points": points,
        "dense_part_id": part_id,
        "part_pose": part_pose,
        "part_center": center,
        "joint_axis": axis,
        "joint_pivot": part_pose[:, :1, :3, 3],
        "joint_state": torch.zeros(clouds, 1),
        "joint_parent": joint,
        "joint_child": joint + 1,
        "joint_type": joint + 1,
        "instance": torch.arange(clouds),
        "scale": torch.ones(clouds),
    }


def registered(labels: dict[str, torch.Tensor], templates: list[torch.Tensor], options: Options) -> Prediction:
    """What Oracle ICP says with these templates [K, M, 3]."""
    method = OracleICP(Problem(num_parts=2, joint_type=1, state_range=1.0, num_points=192), options)
    method.templates = torch.stack(templates)
    return method.predict(seen_in_test(labels, OracleICP.given))


def test_parts_without_symmetry_are_registered_exactly():
    labels = wedge_labels()
    decoy = wedge().mul(0.6).expand(2, 96, 3)
    prediction = registered(labels, [decoy, wedge().expand(2, 96, 3)], replace(FEW, initial_rotations=60))
    metrics = ArticulatedPoseMetrics(calibrate(perfect_oracle(labels), labels), replicates=20)
    metrics.update(prediction, labels)
    result = metrics.compute()
    assert result["r_err_deg"]["mean"] < 0.5
    assert result["t_err"]["mean"] < 1e-3
    assert result["seg_miou"]["mean"] == 1.0
    assert result["chamfer_l1"]["mean"] < 1e-3
    assert result["axis_err_deg"]["mean"] is None


def test_a_part_without_points_counts_with_its_error():
    labels = wedge_labels()
    labels["dense_part_id"] = torch.zeros_like(labels["dense_part_id"])
    prediction = registered(labels, [wedge().expand(2, 96, 3)], FEW)
    torch.testing.assert_close(prediction.part_pose[:, 1, :3, 3], labels["points"].mean(1))


@pytest.mark.parametrize("view", ["complete", "partial"])
def test_command_writes_a_report(tmp_path, view):
    protocol = "honest" if view == "partial" else None
    write_synthetic_set(tmp_path, points=64, states=2, train_instances=1, view=view, protocol=protocol)
    out = tmp_path / "report"
    common = ["--root", str(tmp_path), "--category", "laptop", "--samples", "1", "--points", "64", "--view", view]
    assert main(["oracle_icp", *common, "--out", str(out)]) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["samples"] == 1
    assert report["method"] == "Oracle ICP"
    assert report["protocol"] == (protocol or view)
    assert report["parameters"] == 0
    # Boxes are symmetric under half turns, so only the folded rotation error can be small.
    assert report["legacy_r_err_deg"]["median"] < report["r_err_deg"]["median"] + 1e-6
    # Templates are kept with the rest, so a second run uses them again.
    assert torch.load(out / "weights.pt", weights_only=True)["templates"].shape == (1, 2, 256, 3)


def test_command_without_data_says_how_to_make_it(tmp_path, capsys):
    assert main(["oracle_icp", "--root", str(tmp_path), "--category", "laptop", "--out", str(tmp_path / "out")]) == 2
    assert "make data" in capsys.readouterr().err
