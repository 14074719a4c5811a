import logging
import pickle

import numpy as np
import open3d
import pytest
import trimesh

from articulate_ssl.inference.point_cloud_io import (
    MESH_SAMPLES,
    MIN_POINTS,
    PointCloudError,
    load_point_cloud,
    normalise_cloud,
    save_coloured_ply,
)


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(300, 3)) * 40 + 7


def write(path, points: np.ndarray) -> None:
    match path.suffix:
        case ".npy":
            np.save(path, points)
        case ".npz":
            np.savez(path, points=points, colours=np.zeros(3))
        case ".pcd":
            open3d.io.write_point_cloud(str(path), open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)))
        case ".ply":
            trimesh.PointCloud(points).export(path)
        case ".obj":
            path.write_text("".join("v {:.9g} {:.9g} {:.9g}\n".format(*p) for p in points))


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy", "npz", "obj", "PLY"])
def test_every_format_is_read_in_order(tmp_path, cloud, suffix):
    path = tmp_path / f"scan.{suffix}"
    write(path.with_suffix(path.suffix.lower()), cloud)
    path.with_suffix(path.suffix.lower()).rename(path)
    loaded = load_point_cloud(path)
    assert loaded.shape == cloud.shape
    np.testing.assert_allclose(loaded, cloud, rtol=1e-6, atol=1e-5)


def test_integer_and_float32_clouds_are_numbers_too(tmp_path, cloud):
    np.save(tmp_path / "i.npy", cloud.astype(np.int32))
    assert load_point_cloud(tmp_path / "i.npy").dtype == np.float64


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_a_mesh_is_sampled_over_its_surface_and_says_so(tmp_path, caplog, suffix):
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((4, 2, 1)).export(path)
    with caplog.at_level(logging.WARNING):
        points = load_point_cloud(path)
    assert str(MESH_SAMPLES) in caplog.text
    assert points.shape == (MESH_SAMPLES, 3)
    on_top = np.isclose(points[:, 2], 0.5).mean()
    assert abs(on_top - 8 / 28) < 0.02  # that face's share of the area
    np.testing.assert_array_equal(points, load_point_cloud(path))


def test_a_mesh_in_several_groups_is_sampled_whole(tmp_path):
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.box().apply_translation((5, 0, 0))])
    (tmp_path / "two.obj").write_text(trimesh.exchange.obj.export_obj(scene))
    points = load_point_cloud(tmp_path / "two.obj")
    assert abs((points[:, 0] > 2).mean() - 0.5) < 0.02


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy", "npz", "obj"])
@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda p: p[:1], "one point"),
        (lambda p: p[: MIN_POINTS - 1], f"at least {MIN_POINTS}"),
        (lambda p: np.where(np.arange(len(p))[:, None] == 5, np.nan, p), "1 of 300 points are NaN"),
        (lambda p: np.where(np.arange(len(p))[:, None] == 5, np.inf, p), "1 of 300 points are NaN or infinite"),
        (lambda p: np.broadcast_to(p[:1], p.shape), "coincide"),
    ],
)
def test_an_unusable_cloud_is_refused_in_every_format(tmp_path, cloud, suffix, change, problem):
    path = tmp_path / f"scan.{suffix}"
    write(path, np.ascontiguousarray(change(cloud)))
    with pytest.raises(PointCloudError, match=problem) as error:
        load_point_cloud(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy", "npz", "obj"])
@pytest.mark.parametrize("content", [b"", b"hello\n", b"\x00\xff" * 400])
def test_an_empty_or_foreign_file_is_refused(tmp_path, suffix, content):
    path = tmp_path / f"scan.{suffix}"
    path.write_bytes(content)
    with pytest.raises(PointCloudError, match=r"empty|damaged|no points"):
        load_point_cloud(path)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy", "npz"])
def test_a_truncated_file_is_refused(tmp_path, cloud, suffix):
    path = tmp_path / f"scan.{suffix}"
    write(path, cloud)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(PointCloudError, match="damaged"):
        load_point_cloud(path)


class Trap:
    """Pickle that would show if it were ever read."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def test_pickles_are_not_read(tmp_path):
    (tmp_path / "bare.npy").write_bytes(pickle.dumps(Trap()))
    np.save(tmp_path / "object.npy", np.array([Trap()] * 200, dtype=object), allow_pickle=True)
    np.savez(tmp_path / "object.npz", points=np.array([Trap()] * 200, dtype=object))
    for name in ("bare.npy", "object.npy", "object.npz"):
        with pytest.raises(PointCloudError, match="pickle"):
            load_point_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("array", "problem"),
    [
        (np.zeros((2, 300, 3)), r"shape \[N, 3\].*\[2, 300, 3\]"),
        (np.zeros((300, 6)), r"\[300, 6\]"),
        (np.zeros(3), r"\[3\]"),
        (np.full((300, 3), "x"), "<U1"),
        (np.zeros((300, 3), dtype=complex), "complex"),
    ],
)
def test_wrong_shapes_and_types_are_refused(tmp_path, array, problem):
    np.save(tmp_path / "scan.npy", array)
    with pytest.raises(PointCloudError, match=problem):
        load_point_cloud(tmp_path / "scan.npy")


def test_npz_without_points_lists_what_it_has(tmp_path, cloud):
    np.savez(tmp_path / "scan.npz", xyz=cloud, normals=cloud)
    with pytest.raises(PointCloudError, match="no array `points`, only xyz, normals"):
        load_point_cloud(tmp_path / "scan.npz")


def test_missing_and_unsupported_files_are_refused(tmp_path):
    with pytest.raises(PointCloudError, match="no such file"):
        load_point_cloud(tmp_path / "nowhere.ply")
    with pytest.raises(PointCloudError, match=r"convert it to \.ply"):
        load_point_cloud(tmp_path / "scan.las")


def test_a_renamed_numpy_file_says_its_right_name(tmp_path, cloud):
    np.save(tmp_path / "a.npy", cloud)
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", points=cloud)
    (tmp_path / "b.npz").rename(tmp_path / "b.npy")
    with pytest.raises(PointCloudError, match=r"rename it to a\.npy"):
        load_point_cloud(tmp_path / "a.npz")
    with pytest.raises(PointCloudError, match=r"rename it to b\.npz"):
        load_point_cloud(tmp_path / "b.npy")


def test_coloured_ply_round_trip(tmp_path, cloud):
    colours = np.random.default_rng(1).integers(0, 256, cloud.shape, dtype=np.uint8)
    save_coloured_ply(tmp_path / "c.ply", cloud, colours)
    loaded = trimesh.load(tmp_path / "c.ply")
    np.testing.assert_allclose(loaded.vertices, cloud, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(loaded.colors[:, :3], colours)
    assert [p.name for p in tmp_path.iterdir()] == ["c.ply"]


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
