"""The object in a scan that also shows a table: cut out by what is below it and beside it, in any unit."""

import numpy as np
import pytest
import roma
import torch
import trimesh
from scipy.spatial import cKDTree

from datamodules.point_cloud_io import MIN_POINTS, PointCloudError, Scan, load_point_cloud
from datamodules.standing_object import load_standing_object, standing_object
from render.camera import BACKGROUND, Camera
from render.ray_caster import RayCaster

NOISE = 0.001
PITCH = 35.0  # degrees by which the camera looks down
DISTANCE = 2.0


def box(size, centre) -> trimesh.Trimesh:
    """Resting on or above y = 0."""
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


TABLE = box((2.4, 0.04, 2.4), (0, -0.02, 0))
BASE, LID = box((0.7, 0.04, 0.5), (0, 0.02, 0)), box((0.7, 0.45, 0.02), (0, 0.26, -0.25))
LAPTOP = (BASE, LID)


def view(*meshes: trimesh.Trimesh, pitch: float = PITCH, noise: float = NOISE) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees that looks down at the origin, [N, 3] (x right, y down, z forward), and of which mesh."""
    turn = torch.tensor([np.pi + np.radians(pitch), 0.0, 0.0], dtype=torch.float64)
    pose = np.eye(4)
    pose[:3, :3] = roma.rotvec_to_rotmat(turn).numpy()
    pose[2, 3] = DISTANCE
    camera = Camera(200)
    depth, mesh = RayCaster(meshes).render(np.repeat(pose[None], len(meshes), axis=0), camera)
    seen = np.flatnonzero(mesh.ravel() != BACKGROUND)
    moved = depth.ravel()[seen] + np.random.default_rng(0).normal(0, noise, len(seen))
    return camera.back_project(seen, moved.astype(float)), mesh.ravel()[seen]


def agreement(points: np.ndarray, found: np.ndarray, ours: np.ndarray) -> float:
    """IoU of the points that were found with those that are the object's."""
    tell = {tuple(point): row for row, point in enumerate(points)}
    chosen = np.zeros(len(points), dtype=bool)
    chosen[[tell[tuple(point)] for point in found]] = True
    return float((chosen & ours).sum() / (chosen | ours).sum())


@pytest.mark.parametrize("noise", [0.0, NOISE, 4 * NOISE])
def test_a_laptop_is_cut_from_its_table(noise):
    points, mesh = view(*LAPTOP, TABLE, noise=noise)
    scan = standing_object("scan", Scan(points, ("known before",)))
    assert agreement(points, scan.points, mesh < 2) > 0.97
    assert (mesh == 2).sum() > 2 * (mesh < 2).sum()  # there was something to cut
    before, note = scan.notes
    assert before == "known before" and note.startswith(f"{len(points) - len(scan.points)} of {len(points)} points")


def test_unit_and_order_do_not_matter_and_it_is_the_same_each_time():
    points, _ = view(*LAPTOP, TABLE)
    found = standing_object("scan", Scan(points, ())).points
    np.testing.assert_array_equal(standing_object("scan", Scan(points, ())).points, found)
    in_another_unit = standing_object("scan", Scan(1024 * points, ())).points  # by which floats are divided exactly
    ours = np.isin(points, found).all(axis=1)
    assert agreement(points, in_another_unit / 1024, ours) > 0.99
    in_another_order = standing_object("scan", Scan(points[::-1].copy(), ())).points
    assert agreement(points, in_another_order, ours) > 0.99


def test_a_base_is_not_taken_for_the_table_though_it_shows_more_of_itself():
    small = box((0.9, 0.04, 0.62), (0, -0.02, 0.02))
    points, mesh = view(*LAPTOP, small, pitch=60)
    assert (mesh == 0).sum() > (mesh == 2).sum()
    assert agreement(points, standing_object("scan", Scan(points, ())).points, mesh < 2) > 0.95


def test_a_table_is_not_taken_for_a_thing_on_the_floor():
    table, floor = box((1.9, 0.04, 1.8), (0, -0.02, 0)), box((6.0, 0.04, 6.0), (0, -0.8, -0.6))
    points, mesh = view(*LAPTOP, table, floor)
    assert 1000 < (mesh == 3).sum() < (mesh == 2).sum()
    assert agreement(points, standing_object("scan", Scan(points, ())).points, mesh < 2) > 0.97


def test_a_wall_and_smaller_things_are_left_out():
    wall = box((2.4, 1.6, 0.04), (0, 0.8, -1.2))
    cup = box((0.12, 0.2, 0.12), (0.62, 0.1, 0.2))
    points, mesh = view(*LAPTOP, TABLE, wall, cup)
    assert min((mesh == 3).sum(), (mesh == 4).sum()) > 300
    assert agreement(points, standing_object("scan", Scan(points, ())).points, mesh < 2) > 0.97


def test_a_body_behind_its_open_door_is_of_the_same_object_and_a_box_far_behind_is_not():
    """The door hides what joins them: seen from above they are apart."""
    door, body = box((0.5, 0.6, 0.03), (0, 0.3, 0.13)), box((0.7, 0.8, 0.5), (0, 0.4, -0.22))
    behind = box((0.5, 1.4, 0.2), (0, 0.7, -1.05))
    points, mesh = view(door, body, TABLE, behind, pitch=10)
    apart, _ = cKDTree(points[mesh == 1]).query(points[mesh == 0])
    assert apart.min() > 0.05 and (mesh == 3).sum() > 300
    assert agreement(points, standing_object("scan", Scan(points, ())).points, mesh < 2) > 0.97


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (2.0, 0.5, -1.0), (np.pi, 0.0, 0.0)])
def test_complete_scans_are_in_any_frame(turn):
    """Where there is no camera, the object is on that side of the table where most is."""
    rng, parts = np.random.default_rng(0), (*LAPTOP, TABLE)
    counts = (3000, 3000, 8000)
    points = np.concatenate(
        [trimesh.sample.sample_surface(part, n, seed=1)[0] for part, n in zip(parts, counts, strict=True)]
    )
    mesh = np.repeat(np.arange(3), counts)
    shown = (mesh < 2) & (points[:, 1] > 0.01) | (mesh == 2) & (points[:, 1] > -0.001)
    points, mesh = points[shown] + rng.normal(0, NOISE, (shown.sum(), 3)), mesh[shown]
    turned = points @ roma.rotvec_to_rotmat(torch.tensor(turn, dtype=torch.float64)).numpy().T
    turned -= turned.mean(axis=0)
    found = standing_object("scan", Scan(turned, ())).points
    assert agreement(turned, found, mesh < 2) > 0.97


def _ball(count: int = 4000) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (_ball() + np.array([0, 0, 4]), "it has no flat surface below an object"),
        (view(TABLE)[0], "nothing stands on its flat surfaces"),
        (_ball(MIN_POINTS) + np.array([0, 0, 4]), "(nothing stands on its|it has no) flat surface"),
    ],
    ids=["no table", "nothing on it", "few points"],
)
def test_what_cannot_be_cut_is_refused_by_name_with_what_to_do(points, problem):
    with pytest.raises(PointCloudError, match=rf"^my\.ply: {problem}.*leave --on-table out"):
        standing_object("my.ply", Scan(points, ()))


def test_a_file_is_read_and_what_was_left_out_is_logged(tmp_path, caplog):
    points, _ = view(*LAPTOP, TABLE)
    np.save(tmp_path / "scan.npy", points)
    found = load_standing_object(tmp_path / "scan.npy")
    np.testing.assert_array_equal(found, standing_object("scan", Scan(points, ())).points)
    assert len(found) < len(load_point_cloud(tmp_path / "scan.npy"))
    assert caplog.messages[0].startswith(f"{tmp_path / 'scan.npy'}: ")
    with pytest.raises(PointCloudError, match="no such file"):
        load_standing_object(tmp_path / "none.npy")
