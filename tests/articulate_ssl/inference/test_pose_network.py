"""Poses that a network says in the frame of a prediction."""

from dataclasses import replace

import pytest
import roma
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference import pose_network
from articulate_ssl.inference.pose_network import PoseNetwork, part_poses
from articulate_ssl.network.coordinate_network import CoordinateNetwork
from articulate_ssl.network.surface_network import SurfaceSize
from datamodules.articulated_dataset import ArticulatedDataset

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


@pytest.fixture
def labels(tmp_path, monkeypatch):
    monkeypatch.setattr(pose_network, "SIZE", TINY)
    labels = ArticulatedDataset(write_synthetic_set(tmp_path), "train", num_points=64).__getitems__([0, 1, 2, 3])
    return labels | {name: labels[name].double() for name in labels if labels[name].is_floating_point()}


def _any_network(dtype: torch.dtype) -> PoseNetwork:
    """Heads that say something of every point."""
    torch.manual_seed(0)
    poses = PoseNetwork(2)
    poses.network = CoordinateNetwork(2, TINY)
    for head in (poses.network.pose, poses.network.part_and_coordinates):
        torch.nn.init.normal_(head.weight, std=0.1)
    with torch.no_grad():  # all points are of the first part, and the other is fitted to all, not to a handful
        poses.network.part_and_coordinates.weight[:2] = 0
    return poses.to(dtype)


def _turned(found, rotation):
    """A prediction of the cloud that is turned about the origin."""
    turn = se3(rotation, rotation.new_zeros(3))
    return replace(found, base_pose=turn @ found.base_pose, part_pose=turn @ found.part_pose)


def test_poses_are_those_of_the_coordinates_and_survive_some_wrong_ones():
    generator = torch.Generator().manual_seed(0)
    rotation = roma.random_rotmat(6)
    pose = se3(rotation, torch.randn(6, 3, generator=generator)).view(3, 2, 4, 4)
    coordinates = 0.3 * torch.randn(3, 2, 90, 3, generator=generator)
    part_id = (torch.arange(90) % 2).expand(3, -1)
    own = part_id[:, None, :, None].expand(-1, 1, -1, 3)
    points = transform_points(pose, coordinates).gather(1, own).squeeze(1)
    torch.testing.assert_close(part_poses(coordinates, points, part_id), pose, atol=1e-4, rtol=0)
    coordinates[:, :, ::9] += 2
    few_wrong = part_poses(coordinates, points, part_id)
    assert (few_wrong - pose).abs().max() < 0.2
    assert part_poses(coordinates, points, torch.zeros_like(part_id)).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_said_turns_with_clouds_that_are_predicted_alike(labels, dtype):
    labels = {name: value.to(dtype) if value.is_floating_point() else value for name, value in labels.items()}
    poses, found = _any_network(dtype), perfect_oracle(labels)
    rotation = roma.random_rotmat(1, dtype=dtype)[0]
    turn = se3(rotation, rotation.new_zeros(3))
    clouds = labels["points"], labels["dense_points"]
    moved = tuple(cloud @ rotation.T for cloud in clouds)
    one, other = poses.posed(found, *clouds), poses.posed(_turned(found, rotation), *moved)
    close = {"atol": 1e-2 if dtype == torch.float32 else 1e-8, "rtol": 0}
    torch.testing.assert_close(other.part_pose, turn @ one.part_pose, **close)
    torch.testing.assert_close(other.joint_axis, one.joint_axis @ rotation.T, **close)
    torch.testing.assert_close(other.joint_pivot, one.joint_pivot @ rotation.T, **close)
    torch.testing.assert_close(other.joint_state, one.joint_state, **close)
    assert (one.part_pose - found.part_pose).abs().max() > 0.01  # it does say something
    # Seen in a frame that does not turn with the cloud, it says something else.
    broken = poses.posed(found, *moved)
    assert (broken.part_pose - turn @ one.part_pose).abs().max() > 0.05


def test_parts_are_the_same_however_clouds_are_turned(labels):
    poses, found = _any_network(torch.float64), perfect_oracle(labels)
    torch.nn.init.normal_(poses.network.part_and_coordinates.weight, std=0.1)
    rotation = roma.random_rotmat(1, dtype=torch.float64)[0]
    clouds = labels["points"], labels["dense_points"]
    one = poses.labelled(found, *clouds)
    other = poses.labelled(_turned(found, rotation), *(cloud @ rotation.T for cloud in clouds))
    assert torch.equal(one.dense_part_id, other.dense_part_id) and len(one.dense_part_id.unique()) == 2


def test_labels_alone_leave_poses(labels):
    found = perfect_oracle(labels)
    said = _any_network(torch.float64).labelled(found, labels["points"], labels["dense_points"])
    assert torch.equal(said.part_pose, found.part_pose) and torch.equal(said.joint_state, found.joint_state)
    assert said.dense_part_id.shape == labels["dense_points"].shape[:2]
    assert torch.equal(said.dense_part_id[:, :64], said.part_id)
    assert torch.equal(said.part_probability.argmax(-1), said.part_id)


def test_weights_hold_it_if_it_was_taught(labels):
    taught = _any_network(torch.float32)
    for network in (taught, PoseNetwork(2)):
        other = PoseNetwork(2)
        other.load_state_dict(network.state_dict())
        assert other.learnt == network.learnt
    other.load_state_dict(taught.state_dict())
    for one, same in zip(taught.parameters(), other.parameters(), strict=True):
        assert torch.equal(one, same) and not same.requires_grad
    double = PoseNetwork(2).double()
    double.load_state_dict(taught.state_dict())
    assert all(parameter.dtype == torch.float64 for parameter in double.parameters())
