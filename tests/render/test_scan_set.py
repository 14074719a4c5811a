"""`--source clouds`: a folder of scans becomes a data set without labels, the same however it is made."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import Manifest
from datamodules.shards import UNLABELLED_ARRAYS, read_shard
from datamodules.verify import verify_set
from render.generate import main
from render.scan_cloud import size_of
from render.scan_set import find_scans, object_of, split_objects

MYBOX = ["--category", "mybox", "--source", "clouds", "--parts", "2", "--joint", "revolute"]
POINTS = 256


def scan(seed: int, size: float = 100.0, count: int = 400, depth: float = 0.0) -> np.ndarray:  # [count, 3]
    """A bent plate of two halves."""
    rng = np.random.default_rng(seed)
    halves = rng.uniform([-1, -1, 0], [1, 0, 0.05], (count, 3))
    angle = rng.uniform(0.3, 1.4)
    lid = np.arange(count) % 2 == 1
    lifted = np.stack([halves[:, 0], -np.cos(angle) * halves[:, 1], -np.sin(angle) * halves[:, 1]], axis=1)
    return np.where(lid[:, None], lifted, halves) * size + [0, 0, depth]


@pytest.fixture
def root(tmp_path) -> Path:
    """Five objects: folders of two scans each, and one scan directly in the root, in all kinds of files."""
    root = tmp_path / "scans"
    for index, name in enumerate(("alpha", "beta", "gamma", "delta/session_1")):
        (root / name).mkdir(parents=True)
        np.save(root / name / "a.npy", scan(2 * index))
        (root / name / "b.ply").write_bytes(trimesh.PointCloud(scan(2 * index + 1)).export(file_type="ply"))
    np.savez(root / "single.npz", points=scan(20, size=0.1))
    (root / "alpha" / "notes.txt").write_text("of no interest")
    return root


def make(root: Path, out: Path, *options: str, category=MYBOX, code: int = 0) -> Path:
    """Make a set and return its folder."""
    words = [*category, "--root", str(root), "--out", str(out), "--points", str(POINTS)]
    assert main([*words, "--workers", "1", "--rotations", "3", *options]) == code
    view = "partial-honest" if "partial" in options else "complete"
    return out / "mybox" / f"clouds-{view}"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_folder_of_scans_becomes_shards_without_labels(root, tmp_path, capsys):
    folder = make(root, tmp_path)
    manifest = Manifest.load(folder)
    assert not manifest.labelled and (manifest.split_by, manifest.left_out) == ("instance", {})
    assert manifest.instances == {"train": ("alpha", "beta", "delta", "gamma"), "test": ("single.npz",)}
    assert manifest.scans["train"][2:6] == (
        "beta/a.npy",
        "beta/b.ply",
        "delta/session_1/a.npy",
        "delta/session_1/b.ply",
    )
    train = read_shard(folder / "train" / "shard-00000.npz")
    assert tuple(train) == UNLABELLED_ARRAYS
    assert train["points"].shape == (8, POINTS, 3)
    assert train["instance"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert verify_set(folder) == []
    assert "ignored 1 file(s) .txt" in capsys.readouterr().err


def test_the_stored_points_are_those_of_the_scan_in_even_order(root, tmp_path):
    folder = make(root, tmp_path)
    train = read_shard(folder / "train" / "shard-00000.npz")
    metric = train["points"][0] * train["scale"][0] + train["center"][0]
    gap = np.linalg.norm(metric[:, None] - np.load(root / "alpha" / "a.npy"), axis=2).min(axis=1)
    assert gap.max() < 1e-4
    assert len(np.unique(metric, axis=0)) == POINTS
    first, any_ = metric[:32], metric[np.random.default_rng(0).permutation(POINTS)[:32]]
    apart = [np.sort(np.linalg.norm(c[:, None] - c, axis=2), axis=1)[:, 1].min() for c in (first, any_)]
    assert apart[0] > 2 * apart[1]  # farthest points first


def test_the_table_is_cut_off_if_asked_and_the_set_is_another_one(root, tmp_path, capsys):
    with_table = tmp_path / "with_table"
    for index in range(5):
        folder = with_table / f"object-{index}"
        folder.mkdir(parents=True)
        corner = np.array([300.0, 300.0, 0.0])
        table = np.random.default_rng(index).uniform(-corner, corner, (1000, 3)) - [0, 0, 15]
        np.save(folder / "a.npy", np.concatenate([scan(index), table]))
    cut = read_shard(make(with_table, tmp_path, "--on-table") / "train" / "shard-00000.npz")
    metric = cut["points"] * cut["scale"][:, None, None] + cut["center"][:, None]
    assert metric[..., 2].min() > -14 and np.abs(metric).max() < 120
    assert "points left out: what the object stands on" in capsys.readouterr().err
    make(with_table, tmp_path, code=2)
    assert "on_table True, now None" in capsys.readouterr().err


def test_a_set_from_before_tables_were_cut_off_is_the_same(root, tmp_path):
    folder = make(root, tmp_path)
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["options"]["on_table"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    make(root, tmp_path)


def test_scans_of_an_object_share_a_scale_and_others_have_their_own(root, tmp_path):
    train = read_shard(make(root, tmp_path) / "train" / "shard-00000.npz")
    scale = train["scale"]
    assert scale[0] == scale[1] != scale[2]
    sizes = [size_of(points.astype(float)) * s for points, s in zip(train["points"], scale, strict=True)]
    assert np.median(sizes[:2]) == pytest.approx(scale[0], rel=1e-5)
    own = read_shard(make(root, tmp_path / "own", "--normalise", "scan") / "train" / "shard-00000.npz")
    assert own["scale"][0] != own["scale"][1]
    radius = np.linalg.norm(own["points"], axis=2).mean(axis=1)
    np.testing.assert_allclose(radius, 0.3, rtol=1e-5)


def test_an_object_in_two_units_is_scaled_scan_by_scan_and_named(root, tmp_path, capsys):
    np.save(root / "alpha" / "a.npy", scan(0) / 1000)
    train = read_shard(make(root, tmp_path) / "train" / "shard-00000.npz")
    assert train["scale"][1] > 500 * train["scale"][0]
    assert "alpha: its scans are" in capsys.readouterr().err


def test_test_scans_are_stored_as_scanned_and_turned(root, tmp_path):
    shard = read_shard(make(root, tmp_path) / "test" / "shard-00000.npz")
    points = shard["points"].astype(float)
    assert len(points) == 3
    stored = np.load(root / "single.npz")["points"]
    metric = points[0] * shard["scale"][0] + shard["center"][0]
    assert np.linalg.norm(metric[:, None] - stored, axis=2).min(axis=1).max() < 1e-6
    for turned in points[1:]:
        u, _, vt = np.linalg.svd(points[0].T @ turned)
        np.testing.assert_allclose(points[0] @ (u @ vt), turned, atol=1e-6)
        assert np.linalg.det(u @ vt) > 0 and np.trace(u @ vt) < 2.9


def test_bytes_do_not_depend_on_workers_and_a_stopped_run_is_completed(root, tmp_path):
    expected = contents(make(root, tmp_path / "1"))
    assert contents(make(root, tmp_path / "2", "--workers", "2")) == {
        name: content.replace(str(tmp_path / "1").encode(), str(tmp_path / "2").encode())
        for name, content in expected.items()
    }
    folder = tmp_path / "1" / "mybox" / "clouds-complete"
    shard = folder / "train" / "shard-00000.npz"
    shard.write_bytes(shard.read_bytes()[:-1])
    (folder / "test" / "shard-00000.npz").unlink()
    assert contents(make(root, tmp_path / "1")) == expected


def test_a_scan_that_is_added_later_is_noticed(root, tmp_path, capsys):
    make(root, tmp_path)
    np.save(root / "later.npy", scan(30))
    make(root, tmp_path, code=2)
    assert "train_instances 4, now 5" in capsys.readouterr().err
    (root / "later.npy").rename(root / "alpha" / "later.npy")
    for number in range(6):
        np.save(root / "alpha" / f"more_{number}.npy", np.load(root / "alpha" / "a.npy"))
    make(root, tmp_path, code=2)
    message = capsys.readouterr().err
    assert "added: alpha/later.npy, alpha/more_0.npy" in message and "more_3.npy and 2 more)" in message


def swap(root: Path) -> str:
    """Remove a scan and add a copy of another: as many as before, and in their sorted order."""
    (root / "alpha" / "a.npy").unlink()
    np.save(root / "alpha" / "z.npy", scan(30))
    return "added: alpha/z.npy; removed: alpha/a.npy"


def replace_one(root: Path) -> str:
    np.save(root / "alpha" / "a.npy", scan(30))
    return "changed: alpha/a.npy"


@pytest.mark.parametrize("change", [swap, replace_one])
@pytest.mark.parametrize("finished", [True, False])
def test_a_set_of_other_scans_is_not_gone_on_with(root, tmp_path, monkeypatch, capsys, change, finished):
    shutil.copytree(root, tmp_path / "as it was")
    with monkeypatch.context() as patch:
        if not finished:
            patch.setattr(Manifest, "save", interrupt)
        folder = make(root, tmp_path, code=0 if finished else 130)
    before = contents(folder)
    difference = change(root)
    make(root, tmp_path, code=2)
    message = capsys.readouterr().err
    assert f"({difference})" in message and f"{folder} holds a set" in message and "delete that folder" in message
    assert contents(folder) == before
    shutil.rmtree(root)
    (tmp_path / "as it was").rename(root)
    make(root, tmp_path)
    assert verify_set(folder) == []


def interrupt(*_) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("finished", [True, False])
def test_what_older_versions_did_not_record_is_not_compared(root, tmp_path, monkeypatch, capsys, finished):
    with monkeypatch.context() as patch:
        if not finished:
            patch.setattr(Manifest, "save", interrupt)
        folder = make(root, tmp_path, code=0 if finished else 130)
    file = folder / ("manifest.json" if finished else ".journal.jsonl")
    first, *others = file.read_text().splitlines() if not finished else [file.read_text()]
    content = json.loads(first)
    for new in ("checksums", "contents"):
        content.pop(new, None)
    if finished:
        content["schema_version"] = 3
    file.write_text("\n".join([json.dumps(content), *others]) + "\n")
    replace_one(root)
    make(root, tmp_path)
    if finished:  # which scans they were has always been recorded
        swap(root)
        make(root, tmp_path, code=2)
        assert "(added: alpha/z.npy; removed: alpha/a.npy)" in capsys.readouterr().err


def test_scans_of_one_object_are_split_and_the_manifest_says_so(tmp_path):
    (tmp_path / "scans" / "chair").mkdir(parents=True)
    for index in range(11):
        np.save(tmp_path / "scans" / "chair" / f"{index:02d}.npy", scan(index))
    manifest = Manifest.load(make(tmp_path / "scans", tmp_path))
    assert manifest.split_by == "scan"
    assert manifest.instances == {"train": ("chair",), "test": ("chair",)}
    assert manifest.scans["test"] == ("chair/04.npy", "chair/09.npy")
    assert len(manifest.scans["train"]) == 9 and not set(manifest.scans["train"]) & set(manifest.scans["test"])


@pytest.mark.parametrize(
    ("count", "options", "expected"),
    [
        (10, (None, None), (8, 2)),
        (2, (None, None), (1, 1)),
        (10, (3, 4), (3, 4)),
        (10, (None, 1), (9, 1)),
        (10, (7, None), (7, 3)),
        (1, (1, 0), (1, 0)),
    ],
)
def test_objects_are_split_one_in_five_unless_told_otherwise(count, options, expected):
    objects = {f"object {i}": [f"object {i}/a.ply", f"object {i}/b.ply"] for i in range(count)}
    instances, scans, split_by = split_objects(objects, *options)
    assert (len(instances["train"]), len(instances["test"])) == expected and split_by == "instance"
    assert not set(instances["train"]) & set(instances["test"])
    assert [len(scans[split]) for split in ("train", "test")] == [2 * n for n in expected]


@pytest.mark.parametrize("options", [(5, 6), (11, None), (0, 0)])
def test_splits_that_cannot_be_are_refused(options):
    with pytest.raises(ValueError, match="there are 10 objects"):
        split_objects({str(i): [f"{i}/a.ply"] for i in range(10)}, *options)


def test_hidden_files_are_not_looked_at(root):
    (root / ".trash").mkdir()
    np.save(root / ".trash" / "a.npy", scan(0))
    np.save(root / "alpha" / "._a.npy", scan(0))
    scans, ignored = find_scans(str(root))
    assert not any("._" in name or ".trash" in name for name in scans) and ignored == [(".txt", 1)]
    assert object_of("delta/session_1/a.npy") == "delta" and object_of("single.npz") == "single.npz"


def test_links_are_followed_but_not_in_circles(root, tmp_path):
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    (tmp_path / "elsewhere" / "deep" / "a.NPY").touch()
    expected = find_scans(str(root))[0]
    (root / "linked").symlink_to(tmp_path / "elsewhere")
    (root / "alpha" / "back").symlink_to(root)
    (root / "up").symlink_to(tmp_path)
    (tmp_path / "elsewhere" / "deep" / "again").symlink_to(tmp_path / "elsewhere")
    assert find_scans(str(root))[0] == sorted([*expected, "linked/deep/a.NPY"])


def test_all_broken_scans_are_named_at_once_and_can_be_left_out(root, tmp_path, capsys):
    np.save(root / "beta" / "few.npy", scan(0)[:50])
    spoilt = scan(1)
    spoilt[7, 1] = np.nan
    np.save(root / "beta" / "nan.npy", spoilt)
    np.save(root / "line.npy", np.linspace(0, 1, 200)[:, None] * [1.0, 2, 3])
    (root / "gamma" / "empty.pcd").write_bytes(b"")
    make(root, tmp_path, code=2)
    message = capsys.readouterr().err
    assert "4 of 13 scans" in message and "--skip-broken" in message
    words = {
        "beta/few.npy": "128 are needed",
        "beta/nan.npy": "NaN",
        "line.npy": "on one line",
        "empty.pcd": "is empty",
    }
    for name, word in words.items():
        assert sum(name in line and word in line for line in message.splitlines()) == 1, name
    assert not (tmp_path / "mybox").exists()
    manifest = Manifest.load(make(root, tmp_path, "--skip-broken"))
    assert set(manifest.left_out) == {"beta/few.npy", "beta/nan.npy", "line.npy", "gamma/empty.pcd"}
    assert manifest.left_out["gamma/empty.pcd"].startswith("broken: gamma/empty.pcd: the file is empty")
    assert str(root) not in json.dumps(manifest.left_out)  # wherever the folder lies
    screen = capsys.readouterr().err
    assert all(name in screen for name in manifest.left_out)


def test_a_far_outlier_is_left_out_of_the_set_and_named(root, tmp_path, capsys):
    np.save(root / "alpha" / "a.npy", np.concatenate([scan(0), [[1e5, 0, 0]]]))
    train = read_shard(make(root, tmp_path) / "train" / "shard-00000.npz")
    assert np.abs(train["points"][0]).max() < 2
    screen = capsys.readouterr().err
    assert "1 scan(s): 1 of 401 points left out as outliers" in screen and "alpha/a.npy" in screen


def test_scans_of_few_points_repeat_them_and_say_so(root, tmp_path, capsys):
    np.save(root / "alpha" / "a.npy", scan(0)[:150])
    train = read_shard(make(root, tmp_path) / "train" / "shard-00000.npz")
    assert len(np.unique(train["points"][0], axis=0)) == len(np.unique(train["points"][0][:150], axis=0)) == 150
    assert f"1 scan(s): fewer than {POINTS} points, which are repeated: alpha/a.npy" in capsys.readouterr().err


def depth_views(root: Path, change=lambda points: points) -> Path:
    root.mkdir()
    for index in range(6):
        np.save(root / f"{index}.npy", change(scan(index, depth=600)))
    return root


def test_depth_views_stay_as_the_camera_saw_them(tmp_path):
    folder = make(depth_views(tmp_path / "views"), tmp_path, "--view", "partial")
    manifest, shard = Manifest.load(folder), read_shard(folder / "test" / "shard-00000.npz")
    assert (manifest.protocol, manifest.num_samples("test")) == ("honest", 1)
    metric = shard["points"][0] * shard["scale"][0] + shard["center"][0]
    assert np.linalg.norm(metric[:, None] - np.load(tmp_path / "views" / "5.npy"), axis=2).min(axis=1).max() < 1e-3
    assert np.linalg.norm(shard["points"][0], axis=1).mean() == pytest.approx(0.3, rel=1e-5)


@pytest.mark.parametrize(
    ("change", "word"),
    [(lambda p: p * [1, -1, -1], "multiply y and z by -1"), (lambda p: p - p.mean(axis=0), "inside the object")],
)
def test_depth_views_in_other_axes_are_refused(tmp_path, capsys, change, word):
    make(depth_views(tmp_path / "views", change), tmp_path, "--view", "partial", code=2)
    assert word in capsys.readouterr().err


def test_a_training_configuration_is_written_once(root, tmp_path, capsys):
    folder = make(root, tmp_path)
    config = folder / "config.yaml"
    assert f"train with: lightning fit -c {config}" in capsys.readouterr().out
    content = yaml.safe_load(config.read_text())
    assert content["data"] == {
        "category": "mybox", "root": str(tmp_path), "source": "clouds", "view": "complete", "num_points": POINTS,
        "batch_size": 8,
    }  # fmt: skip
    assert content["model"] == {"num_parts": 2, "joint_type": "revolute", "state_range": pytest.approx(1.5708)}
    assert content["trainer"]["default_root_dir"] == "runs/mybox"
    options = {name: content["data"][name] for name in ("category", "root", "source", "view", "num_points")}
    module = ArticulatedDataModule(**options)
    module.setup("fit")
    assert module.folder == folder and len(module.train_set) == 8
    config.write_text("# mine\n")
    make(root, tmp_path)
    assert config.read_text() == "# mine\n"
    assert "kept as it is" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["45427", "on", "null", "1e3"])
def test_a_category_is_a_name_whatever_yaml_takes_it_for(root, tmp_path, name):
    category = ["--category", name, *MYBOX[2:]]
    make(root, tmp_path, category=category)
    content = yaml.safe_load((tmp_path / name / "clouds-complete" / "config.yaml").read_text())
    assert content["data"]["category"] == name


def test_the_configuration_of_depth_views_is_for_an_upright_camera(tmp_path):
    config = make(depth_views(tmp_path / "views"), tmp_path, "--view", "partial") / "config.yaml"
    content = yaml.safe_load(config.read_text())
    assert (content["data"]["view"], content["model"]["orientation_range"]) == ("partial", 100)


def test_a_category_can_be_a_file_of_the_users(root, tmp_path):
    file = tmp_path / "mybox.yaml"
    file.write_text("parts: [box, lid, drawer]\njoints: [{type: prismatic}, {type: prismatic, parent: lid}]\n")
    category = ["--category", str(file), "--source", "clouds"]
    folder = make(root, tmp_path, category=category)
    manifest = Manifest.load(folder)
    assert (manifest.part_names, manifest.joint_types) == (("box", "lid", "drawer"), (1, 1))
    assert yaml.safe_load((folder / "config.yaml").read_text())["model"]["joint_type"] == "prismatic"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--category", "mybox"], "say --parts <number> and --joint"),
        (["--category", "mybox", "--parts", "2"], "say --parts <number> and --joint"),
        (["--category", "my box", "--parts", "2", "--joint", "revolute"], "use letters, digits"),
        (["--category", "laptop", "--parts", "2", "--joint", "revolute"], "leave --parts and --joint out"),
        (["--category", "laptop", "--states", "3"], "takes no --states"),
        (["--category", "laptop", "--variant", "x"], "takes no --variant"),
        (["--category", "laptop", "--on-table"], "a.npy: it has no flat surface below an object"),
        (["--category", "laptop", "--view", "partial", "--protocol", "eap"], "--protocol eap"),
        (["--category", "laptop", "--normalise", "none"], "has 400 points; --normalise none needs --points 4096"),
        (["--category", "nowhere.yaml"], "nowhere.yaml: cannot be read"),
    ],
)
def test_bad_arguments_exit_with_2_and_one_message(root, tmp_path, capsys, words, message):
    code = main([*words, "--source", "clouds", "--root", str(root), "--out", str(tmp_path), "--workers", "1"])
    assert code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_root_without_scans_is_named(tmp_path, capsys, name):
    (tmp_path / "empty").mkdir()
    make(tmp_path / name, tmp_path, code=2)
    assert str(tmp_path / name) in capsys.readouterr().err


def test_other_sources_take_no_options_of_scans(tmp_path, capsys):
    assert main(["--category", "laptop", "--parts", "2", "--out", str(tmp_path)]) == 2
    assert "source 'procedural' takes no --parts" in capsys.readouterr().err
