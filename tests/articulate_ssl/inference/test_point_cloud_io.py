import numpy as np
import open3d
import pytest
import trimesh

from articulate_ssl.inference.point_cloud_io import load_point_cloud, normalise_cloud, save_coloured_ply


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(300, 3)) * 40 + 7


def test_coloured_ply_round_trip(tmp_path, cloud):
    colours = np.random.default_rng(1).integers(0, 256, cloud.shape, dtype=np.uint8)
    save_coloured_ply(tmp_path / "c.ply", cloud, colours)
    loaded = trimesh.load(tmp_path / "c.ply")
    np.testing.assert_array_equal(loaded.vertices, cloud)
    np.testing.assert_array_equal(loaded.colors[:, :3], colours)
    assert [p.name for p in tmp_path.iterdir()] == ["c.ply"]


def test_a_scan_in_metres_of_a_map_keeps_its_points_in_every_reader(tmp_path, cloud):
    far = cloud / 400 + [500000, 5400000, 300]
    save_coloured_ply(tmp_path / "c.ply", far, np.full(cloud.shape, 51, dtype=np.uint8))
    by_open3d = open3d.io.read_point_cloud(str(tmp_path / "c.ply"))
    for points in (trimesh.load(tmp_path / "c.ply").vertices, by_open3d.points, load_point_cloud(tmp_path / "c.ply")):
        np.testing.assert_array_equal(points, far)
    np.testing.assert_allclose(by_open3d.colors, 0.2)


def test_normalisation_of_an_observed_cloud(cloud):
    points, center, scale = normalise_cloud(cloud, len(cloud))
    np.testing.assert_allclose(center, cloud.mean(axis=0))
    assert np.linalg.norm(points, axis=1).mean() == pytest.approx(0.3, rel=1e-5)
    restored = points * scale + center
    np.testing.assert_allclose(np.sort(restored, axis=0), np.sort(cloud, axis=0), atol=1e-3)


def test_a_given_normalisation_is_used(cloud):
    points, center, scale = normalise_cloud(cloud, 64, center=np.array([1.0, 2, 3]), scale=50.0)
    assert scale == 50 and center.tolist() == [1, 2, 3]
    distance = np.abs(points[:, None] * 50 + center - cloud).max(axis=2).min(axis=1)
    assert distance.max() < 1e-4


def test_normalisation_ignores_the_users_unit_and_origin(cloud):
    points = normalise_cloud(cloud, 128)[0]
    moved = normalise_cloud(cloud * 1000 + 12345, 128)[0]
    np.testing.assert_allclose(moved, points, atol=1e-5)


def test_few_points_are_repeated_and_many_are_thinned(cloud):
    few = normalise_cloud(cloud[:130], 256)[0]
    assert few.shape == (256, 3)
    assert len(np.unique(few, axis=0)) == 130
    many = normalise_cloud(np.random.default_rng(0).random((200_000, 3)), 256)[0]
    assert many.shape == (256, 3) and len(np.unique(many, axis=0)) == 256
