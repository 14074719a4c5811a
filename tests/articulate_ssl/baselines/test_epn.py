import pytest
import roma
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.epn import READ_POINTS, SHAPE_POINTS
from articulate_ssl.baselines.epn_whole import EPNWhole
from articulate_ssl.baselines.method import POSES, RECONSTRUCTION, Problem
from articulate_ssl.baselines.oracle_epn import OracleEPN
from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.metrics.articulated_pose import cloud_errors
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.ops.chamfer import chamfer
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import ArticulatedDataset


def some(folder, count=4):
    return ArticulatedDataset(folder, "train", num_points=64).__getitems__(list(range(count)))


def make(kind, seed=0):
    torch.manual_seed(seed)
    return kind(Problem(2, REVOLUTE, 1.5, 64))


@pytest.mark.parametrize("kind", [OracleEPN, EPNWhole])
def test_it_learns_what_a_checkpoint_keeps(synthetic_set, kind, tmp_path):
    labels, method = some(synthetic_set), make(kind)
    optimizer = torch.optim.Adam(method.parameters(), lr=5e-3)
    losses = []
    for step in range(8):
        loss = method.training_step(labels, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.9 * losses[0]
    method.bidirectional.fill_(False)
    torch.save(method.state_dict(), tmp_path / "weights.pt")
    again = make(kind, seed=1)
    again.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True))
    assert not again.bidirectional
    torch.testing.assert_close(again.predict(labels).part_pose, method.predict(labels).part_pose)


@pytest.mark.parametrize("kind", [OracleEPN, EPNWhole])
def test_a_turned_cloud_has_turned_poses_and_the_same_shape(synthetic_set, kind):
    labels, method = some(synthetic_set), make(kind)
    rotation = rotation_group(12).elements[5].float()
    other = labels | {name: labels[name] @ rotation.T for name in ("points", "dense_points")}
    first, second = method.predict(labels), method.predict(other)
    expected = transform_points(first.part_pose, first.part_shape) @ rotation.T
    torch.testing.assert_close(transform_points(second.part_pose, second.part_shape), expected, atol=1e-3, rtol=0)


def test_true_parts_are_all_that_oracle_epn_sees(synthetic_set):
    labels, method = some(synthetic_set), make(OracleEPN)
    parts = method.true_parts(labels)
    assert parts.shape == (4, 2, READ_POINTS, 3)
    for cloud, points, part_id in zip(parts, labels["dense_points"], labels["dense_part_id"], strict=True):
        for k in range(2):
            assert torch.cdist(cloud[k], points[part_id == k]).amin(1).max() < 1e-3
    prediction = method.predict(labels)
    assert torch.equal(prediction.part_id, labels["dense_part_id"][:, :64])
    del labels["dense_part_id"]
    with pytest.raises(ValueError, match="dense_in_fit"):
        method.training_step(labels, 0)


def test_oracle_epn_with_the_true_shapes_and_poses_scores_without_error(synthetic_set, monkeypatch):
    labels, method = some(synthetic_set, 8), make(OracleEPN)
    found, truth_of = iter([0, 1] * 2), perfect_oracle(labels)

    def truth(network, points):
        k = next(found)
        pose = truth_of.part_pose[:, k]
        shape = transform_points(torch.linalg.inv(pose), points)
        zero = torch.zeros(8)
        return type("Found", (), {"shape": shape, "pose": pose, "error": zero, "margin": zero})

    monkeypatch.setattr(method, "reconstruct", truth)
    prediction = method.predict(labels)
    errors = cloud_errors(prediction, labels, calibrate(method.predict(labels), labels))
    assert errors["r_err_deg"].max() < 0.1
    assert errors["t_err"].max() < 1e-3
    assert errors["axis_err_deg"].isnan().all()
    assert method.says == (POSES,)


def test_the_whole_shape_is_one_reconstruction_and_claims_nothing_else(synthetic_set):
    labels, method = some(synthetic_set), make(EPNWhole)
    prediction = method.predict(labels)
    assert method.says == (RECONSTRUCTION,)
    assert prediction.part_shape.shape == (4, 2, SHAPE_POINTS, 3)
    assert torch.equal(prediction.part_pose[:, 0], prediction.part_pose[:, 1])
    posed = transform_points(prediction.part_pose, prediction.part_shape).flatten(1, 2)
    torch.testing.assert_close(chamfer(labels["points"], posed), prediction.reconstruction_error, atol=1e-4, rtol=0)
    rotation = prediction.part_pose[..., :3, :3]
    assert roma.is_rotation_matrix(rotation, 1e-4)


@pytest.mark.parametrize(("view", "protocol"), [("complete", None), ("partial", "honest")])
def test_views_are_not_charged_for_what_they_do_not_show(tmp_path, view, protocol):
    method, folder = make(EPNWhole), write_synthetic_set(tmp_path, view=view, protocol=protocol)
    category = folder.parent.name
    method.prepare(ArticulatedDataModule(category, str(folder.parent.parent), view=view, protocol=protocol), 0)
    assert bool(method.bidirectional) is (view == "complete")
