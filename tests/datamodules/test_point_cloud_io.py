"""Reading scans: every format, and one clear word for whatever is no usable cloud."""

import logging
import pickle

import numpy as np
import open3d
import pytest
import trimesh

from datamodules.point_cloud_io import (
    MESH_SAMPLES,
    MIN_POINTS,
    PointCloudError,
    load_point_cloud,
    read_scan,
    usable_scan,
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


@pytest.mark.parametrize("ascii_rows", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_a_pcd_of_double_precision_is_read_in_it(tmp_path, cloud, ascii_rows, compressed):
    cloud += [500000, 5400000, 300]
    tensors = open3d.t.geometry.PointCloud(open3d.core.Tensor(cloud))
    open3d.t.io.write_point_cloud(str(tmp_path / "scan.pcd"), tensors, write_ascii=ascii_rows, compressed=compressed)
    np.testing.assert_allclose(load_point_cloud(tmp_path / "scan.pcd"), cloud, rtol=0, atol=1e-3)


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


@pytest.mark.parametrize(
    ("suffix", "head"),
    [
        ("pcd", "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300\nHEIGHT 1\nPOINTS 300\nDATA ascii\n"),
        ("ply", "ply\nformat ascii 1.0\nelement vertex 300\n{}end_header\n".format("property float {}\n" * 3)),
    ],
)
def test_text_that_ends_too_early_is_refused(tmp_path, cloud, suffix, head):
    path = tmp_path / f"scan.{suffix}"
    rows = [" ".join(map(str, point)) + "\n" for point in cloud.tolist()]
    path.write_text(head.format(*"xyz") + "".join(rows))
    assert len(load_point_cloud(path)) == 300
    for end in ("", " ".join(rows[200].split()[:2])):
        path.write_text(head.format(*"xyz") + "".join(rows[:200]) + end)
        with pytest.raises(PointCloudError, match=rf"scan\.{suffix}: damaged.* 20[01] of 300"):
            load_point_cloud(path)


def test_a_mesh_in_text_that_lacks_faces_is_refused(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(trimesh.creation.icosphere().export(file_type="ply", encoding="ascii"))
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-99]))
    with pytest.raises(PointCloudError, match=r"cut off: 1823 of 1922 rows"):
        load_point_cloud(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [(b"(300, 3)", b"(300, 3"), (b"(300, 3), }        ", b"(99999999999, 3), }"), (b"'descr'", b"'des\xff'")],
)
def test_a_damaged_numpy_header_is_refused(tmp_path, cloud, old, new):
    np.save(tmp_path / "scan.npy", cloud)
    content = (tmp_path / "scan.npy").read_bytes()
    assert old in content
    (tmp_path / "scan.npy").write_bytes(content.replace(old, new))
    with pytest.raises(PointCloudError, match="damaged"):
        load_point_cloud(tmp_path / "scan.npy")


def test_a_pcd_of_unknown_types_is_refused(tmp_path, cloud):
    write(tmp_path / "scan.pcd", cloud)
    content = (tmp_path / "scan.pcd").read_bytes()
    (tmp_path / "scan.pcd").write_bytes(content.replace(b"TYPE F F F", b"TYPE F Q F"))
    with pytest.raises(PointCloudError, match=r"scan\.pcd: damaged, or of types"):
        load_point_cloud(tmp_path / "scan.pcd")


def test_a_damaged_archive_is_refused_wherever_it_is_damaged(tmp_path, cloud):
    np.savez_compressed(tmp_path / "scan.npz", points=cloud)
    content = (tmp_path / "scan.npz").read_bytes()
    method = content.index(b"PK\x01\x02") + 10  # of compression, in the table of contents
    for place in (len(content) // 2, method, method + 6):
        (tmp_path / "scan.npz").write_bytes(content[:place] + b"\x63" + content[place + 1 :])
        with pytest.raises(PointCloudError, match="damaged"):
            load_point_cloud(tmp_path / "scan.npz")


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


@pytest.mark.parametrize("suffix", ["ply", "npy"])
def test_a_line_of_points_is_refused(tmp_path, suffix):
    rng = np.random.default_rng(0)
    line = rng.uniform(-3, 3, (300, 1)) * [1.0, 2.0, 0.5] + 10 + rng.normal(scale=1e-4, size=(300, 3))
    write(tmp_path / f"scan.{suffix}", line)
    with pytest.raises(PointCloudError, match=rf"scan.{suffix}: all 300 points lie on one line"):
        load_point_cloud(tmp_path / f"scan.{suffix}")


def test_a_plane_of_points_and_a_thin_rod_are_no_lines(tmp_path):
    rng = np.random.default_rng(0)
    for width in ([1, 1, 0], [1, 0.02, 0.02]):
        np.save(tmp_path / "scan.npy", rng.uniform(-1, 1, (300, 3)) * width)
        assert read_scan(tmp_path / "scan.npy").notes == ()


@pytest.mark.parametrize("far", [20.0, 1e9])
def test_far_outliers_are_left_out_and_counted(tmp_path, cloud, caplog, far):
    spoilt = np.concatenate([cloud[:100], [[far * 40, 0, 0], [0, -far * 40, 0]], cloud[100:]])
    np.save(tmp_path / "scan.npy", spoilt)
    with caplog.at_level(logging.WARNING):
        points = load_point_cloud(tmp_path / "scan.npy")
    np.testing.assert_array_equal(points, cloud)
    assert "scan.npy: 2 of 302 points left out as outliers" in caplog.text


def test_points_that_stand_off_within_reason_stay(tmp_path, cloud):
    radius = np.quantile(np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1), 0.9)
    np.save(tmp_path / "scan.npy", np.vstack([cloud, np.median(cloud, axis=0) + np.array([4 * radius, 0, 0])]))
    scan = read_scan(tmp_path / "scan.npy")
    assert len(scan.points) == 301 and scan.notes == ()


def test_a_cloud_of_which_too_little_is_left_is_refused(cloud):
    far = np.concatenate([cloud[:120], 1e6 + cloud[120:132]])
    with pytest.raises(PointCloudError, match=r"12 of 132 points left out as outliers.*holds 120 points"):
        usable_scan("scan", far)


@pytest.mark.parametrize("place", [(0, 0, 0), (1.5, -2, 900)])
def test_pixels_without_depth_are_left_out_and_counted(cloud, place):
    """A camera has them at its origin, which a user may have moved."""
    scan = usable_scan("scan", np.concatenate([cloud[:50], np.tile(np.array(place), (20, 1)), cloud[50:]]))
    np.testing.assert_array_equal(scan.points, cloud)
    (note,) = scan.notes
    assert "20 of 320 points left out as pixels without depth" in note
    assert "exactly ({:g}, {:g}, {:g})".format(*place) in note


def test_clouds_that_repeat_points_as_they_come_stay_as_they_are(cloud):
    """Quantised to a few places, drawn with replacement, padded from the beginning, or with one pixel at the origin."""
    drawn = cloud[np.random.default_rng(0).integers(300, size=4096)]
    solid = np.random.default_rng(0).integers(-3, 4, (4096, 3))
    for points in (solid, (drawn / 20).round(), drawn, np.resize(cloud, (450, 3)), np.vstack([cloud, np.zeros(3)])):
        scan = usable_scan("scan", points)
        np.testing.assert_array_equal(scan.points, points)
        assert scan.notes == ()


def test_few_points_do_not_become_many_by_repetition(cloud):
    with pytest.raises(PointCloudError, match=r"scan: its 400 points lie at 100 different places, at least 128"):
        usable_scan("scan", np.repeat(cloud[:100], 4, axis=0))
