"""A network learns poses from fits, and is kept if it comes nearer to those that did not teach it."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import roma
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference import pose_network
from articulate_ssl.inference.pose_network import PoseNetwork
from articulate_ssl.network.coordinate_network import CoordinateNetwork
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.training import pose_lessons
from articulate_ssl.training.pose_lessons import PoseLessons, learn_poses, teach
from datamodules.articulated_dataset import ArticulatedDataset

TINY = SurfaceSize(read=64, centers=32, dims=(16, 16), radii=(0.3, 0.5), num_neighbors=8, global_dim=32, head_dim=32)
CLOUDS = 24


@pytest.fixture
def labels(tmp_path, monkeypatch):
    for module in (pose_network, pose_lessons):
        monkeypatch.setattr(module, "SIZE", TINY)
    folder = write_synthetic_set(tmp_path, train_instances=4, states=6)
    return ArticulatedDataset(folder, "train", num_points=96).__getitems__(list(range(CLOUDS)))


def _fits(labels):
    """As right as fits can be."""
    found = perfect_oracle(labels)
    return replace(found, dense_part_id=labels["dense_part_id"].long())


class _Module:
    """Its registered predictions are right; others are turned by thirty degrees and more."""

    def __init__(self, labels) -> None:
        self.estimator = SimpleNamespace(pose_network=PoseNetwork(2))
        self.num_points, self.inference = 96, SimpleNamespace(points=0)
        self.clouds, self.fits = labels["dense_points"], _fits(labels)
        turn = roma.rotvec_to_rotmat(0.4 * torch.randn(CLOUDS, 3, generator=torch.Generator().manual_seed(0)))
        self.turn = se3(turn, torch.zeros(CLOUDS, 3))

    def predict_points(self, points, refine, dense):
        rows = [int((self.clouds[:, 0] - one[0]).abs().sum(-1).argmin()) for one in dense]
        found = self.fits[rows]
        if refine is None:
            return found
        base, pose = found.base_pose @ self.turn[rows], found.part_pose @ self.turn[rows][:, None]
        found = replace(found, base_pose=base, part_pose=pose)
        poses = self.estimator.pose_network
        return poses.posed(found, points, dense) if poses.learnt else found


def test_it_learns_where_parts_are(labels, monkeypatch):
    monkeypatch.setattr(pose_lessons, "_TIMES", 200)
    lessons = PoseLessons.of(labels["dense_points"], _fits(labels))
    shown, frame = lessons.draw(torch.Generator().manual_seed(1))
    with torch.no_grad():
        before, after = (float(shown.loss(network, frame)) for network in (_untaught(lessons), teach(lessons)))
    assert after < 0.4 * before


def _untaught(lessons):
    torch.manual_seed(0)
    return pose_lessons.CoordinateNetwork(lessons.pose.shape[1], TINY)


def test_clouds_are_shown_near_their_frames_and_of_points_whose_parts_are_known(labels):
    lessons = PoseLessons.of(labels["dense_points"], _fits(labels))
    shown, frame = lessons.draw(torch.Generator().manual_seed(0))
    assert shown.points.shape == (pose_lessons.BATCH, TINY.read, 3)
    angle = roma.rotmat_geodesic_distance(frame, shown.pose[:, lessons.root, :3, :3]).rad2deg()
    assert 1 < angle.mean() < 20 and angle.min() < 6
    whole = dict(zip(map(tuple, labels["dense_points"][0].tolist()), labels["dense_part_id"][0].tolist(), strict=True))
    mine = [b for b in range(len(shown.points)) if tuple(shown.points[b, 0].tolist()) in whole]
    for b in mine:
        assert [whole[tuple(point)] for point in shown.points[b].tolist()] == shown.part_id[b].tolist()
    assert mine


@pytest.mark.parametrize("times, rate, kept", [(300, pose_lessons.RATE, True), (40, 1e-9, False)])
def test_it_is_kept_if_it_comes_nearer_to_fits_of_other_clouds(labels, monkeypatch, caplog, times, rate, kept):
    monkeypatch.setattr(pose_lessons, "FEWEST", CLOUDS)
    monkeypatch.setattr(pose_lessons, "_TIMES", times)
    monkeypatch.setattr(pose_lessons, "RATE", rate)
    module = _Module(labels)
    learn_poses(module, labels["dense_points"])
    assert module.estimator.pose_network.learnt == kept
    assert ("there is none" in caplog.text) != kept


def test_few_clouds_teach_nothing(labels):
    module = _Module(labels)
    learn_poses(module, labels["dense_points"])
    assert not module.estimator.pose_network.learnt


def test_axes_teach_no_features(labels):
    """But the layer that says them: with other axes its gradient differs, and no other's does."""
    network, lessons = CoordinateNetwork(2, TINY), PoseLessons.of(labels["dense_points"], _fits(labels))
    frame, gradients = lessons.pose[:, lessons.root, :3, :3].float(), []
    for one in (lessons, replace(lessons, axis=lessons.axis.roll(1, dims=-1))):
        drawn = replace(one, points=one.points[:, : TINY.read].float(), part_id=one.part_id[:, : TINY.read])
        network.zero_grad()
        drawn.loss(network, frame).backward()
        gradients.append({name: value.grad.clone() for name, value in network.named_parameters()})
    differ = {name for name, value in gradients[0].items() if not torch.equal(value, gradients[1][name])}
    assert differ == {"structure.weight", "structure.bias"}
