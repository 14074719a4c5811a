"""Occupancy samples: what is inside agrees with geometry, wherever the object stands and whoever asks."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh
from objects import box, box_laptop

from datamodules.manifest import set_folder
from datamodules.occupancy import OccupancyIndex, open_samples, samples_path
from render.generate import main
from render.occupancy import VOXEL, SolidPart, sample_occupancy
from render.posing import pose_labels, sample_rotation

POINTS = 512


def labels_of(state: float, seed: int) -> dict[str, np.ndarray]:
    """Labels of the box laptop in a random pose."""
    rng = np.random.default_rng(seed)
    laptop = box_laptop()
    states = np.array([state])
    motion = laptop.part_motion(states)
    return pose_labels(laptop, states, motion, sample_rotation(rng), np.zeros(3), rng.normal(size=3), 0.4)


def samples_of(labels: dict[str, np.ndarray], seed: int = 0, count: int = 4000, voxel: float = VOXEL):
    laptop = box_laptop()
    solids = [SolidPart(mesh) for mesh in laptop.meshes]
    rng = np.random.default_rng(seed)
    return sample_occupancy(laptop, solids, labels["part_pose"], float(labels["scale"]), count, rng, voxel)


def box_distance(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Signed distance to an axis-aligned box; exact outside, and inside within a face's reach."""
    center, half = mesh.bounds.mean(0), np.ptp(mesh.bounds, axis=0) / 2
    beyond = np.abs(points - center) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)


@pytest.mark.parametrize("voxel", [0.0, VOXEL])
def test_inside_is_what_the_boxes_contain_in_any_pose(voxel):
    labels, laptop = labels_of(1.2, 3), box_laptop()
    points, inside = samples_of(labels, voxel=voxel)
    expected = np.zeros(len(points), dtype=bool)
    unsure = np.zeros(len(points), dtype=bool)
    margin = voxel / 2 * laptop.rest_diagonal
    for mesh, pose in zip(laptop.meshes, labels["part_pose"], strict=True):
        at_rest = (points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3] * 0.4
        distance = box_distance(at_rest, mesh)
        expected |= distance < margin
        unsure |= np.abs(distance - margin) < 1e-6
    np.testing.assert_array_equal(inside[~unsure], expected[~unsure])
    assert 0.02 < inside.mean() < 0.6


def test_the_share_inside_is_the_volume():
    """Uniform points in a box's surroundings: the share inside is its part of the volume."""
    solid = SolidPart(box([0, 0, 0], [0.5, 1, 0.25]))
    points = np.random.default_rng(0).uniform(-0.5, 1.5, (20000, 3))
    share = solid.contains(points, 0.0).mean()
    assert abs(share - 0.125 / 8) < 4 * np.sqrt(0.125 / 8 / 20000)


def test_overlapping_solids_of_one_part_are_their_union():
    """Two boxes in one mesh: an even number of crossings is still inside."""
    both = trimesh.util.concatenate([box([0, 0, 0], [1, 1, 1]), box([0.5, 0, 0], [1.5, 1, 1])])
    points = np.array([[0.25, 0.4, 0.6], [0.75, 0.4, 0.6], [1.25, 0.4, 0.6], [1.75, 0.4, 0.6]])
    assert SolidPart(both).contains(points, 0.0).tolist() == [True, True, True, False]
    np.testing.assert_allclose(SolidPart(both).winding_number(points), [1, 2, 1, 0])


def test_an_open_box_has_an_inside_and_a_sheet_has_only_its_thickness():
    mesh = box([0, 0, 0], [1, 1, 1])
    open_box = trimesh.Trimesh(mesh.vertices, mesh.faces[2:], process=False)  # one side is missing
    assert not open_box.is_watertight
    assert SolidPart(open_box).contains(np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]), 0.0).tolist() == [True, False]
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    points = np.array([[0.5, 0.4, 0.004], [0.5, 0.4, -0.004], [0.5, 0.4, 0.02]])
    assert SolidPart(sheet).contains(points, 0.0).tolist() == [False, False, False]
    assert SolidPart(sheet).contains(points, 0.008).tolist() == [True, True, False]


def test_points_are_near_the_surface_and_around_the_object():
    labels = labels_of(0.4, 0)
    points, inside = samples_of(labels)
    laptop = box_laptop()
    distance = np.min(
        [
            np.abs(box_distance((points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3] * 0.4, mesh))
            for mesh, pose in zip(laptop.meshes, labels["part_pose"], strict=True)
        ],
        axis=0,
    )
    near, around = distance[:2000], distance[2000:]
    assert np.median(near) < 2 * VOXEL * laptop.rest_diagonal < np.median(around)
    assert inside[:2000].mean() > 2 * inside[2000:].mean()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small set without samples, its bytes, and a copy of the command."""
    out = tmp_path_factory.mktemp("set")
    command = ["--category", "laptop", "--out", str(out), "--workers", "1", "--train-instances", "2"]
    command += ["--test-instances", "1", "--states", "2", "--rotations", "1", "--points", "1024"]
    assert main(command) == 0
    folder = set_folder(out, "laptop")
    before = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    assert main([*command, "--occupancy", str(POINTS)]) == 0
    return command, folder, before


def test_a_finished_set_gets_samples_and_keeps_its_bytes(made):
    _, folder, before = made
    after = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    assert {name: after[name] for name in before} == before
    assert sorted(str(name) for name in set(after) - set(before)) == [
        "occupancy/occupancy.json",
        "occupancy/train/shard-00000.npy",
        "occupancy/train/shard-00001.npy",
    ]
    samples = open_samples(samples_path(folder, "train", "shard-00001.npz"), 2, POINTS)
    assert set(np.unique(samples[..., 3])) == {0.0, 1.0}


def test_samples_are_reproducible_and_repaired(made):
    command, folder, _ = made
    path = samples_path(folder, "train", "shard-00000.npz")
    right, other = path.read_bytes(), samples_path(folder, "train", "shard-00001.npz")
    path.write_bytes(right[:-1] + b"x")
    untouched = other.stat().st_mtime_ns
    assert main([*command, "--occupancy", str(POINTS)]) == 0
    assert path.read_bytes() == right
    assert other.stat().st_mtime_ns == untouched


def test_the_index_names_shards_by_their_checksums(made):
    _, folder, _ = made
    index = OccupancyIndex.load(folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (index.points, index.voxel) == (POINTS, VOXEL)
    assert [e.shard_sha256 for e in index.entries] == [s["sha256"] for s in manifest["shards"]["train"]]


def test_samples_lie_where_the_cloud_lies(made):
    """Points of the cloud are on the surface, so nearly every sample next to one is inside, within half a voxel."""
    _, folder, _ = made
    samples = open_samples(samples_path(folder, "train", "shard-00000.npz"), 2, POINTS).astype(np.float32)
    cloud = np.load(folder / "train" / "shard-00000.npz")["points"]
    nearest = torch.cdist(torch.from_numpy(samples[..., :3]), torch.from_numpy(cloud)).amin(-1).numpy()
    inside = samples[..., 3] > 0
    assert inside[nearest < 0.3 * VOXEL].all() and (nearest < 0.3 * VOXEL).any()
    assert not inside[nearest > 0.2].any()


def test_a_set_of_test_clouds_alone_needs_no_samples(tmp_path):
    """Methods learn from training clouds."""
    command = ["--category", "laptop", "--out", str(tmp_path), "--workers", "1", "--train-instances", "0"]
    command += ["--test-instances", "1", "--states", "1", "--rotations", "1", "--points", "64", "--occupancy", "8"]
    assert main(command) == 0
    assert OccupancyIndex.load(set_folder(tmp_path, "laptop")).entries == ()


def test_scans_take_no_occupancy(tmp_path, capsys):
    assert main(["--category", "laptop", "--source", "clouds", "--root", str(tmp_path), "--occupancy", "8"]) == 2
    assert "takes no --occupancy" in capsys.readouterr().err
