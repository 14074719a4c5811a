"""`python -m render.generate`: same bytes however they are made, resumable, and one clear message for bad input."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import forkserver
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest
import torch
from dask.distributed import LocalCluster

from articulate_ssl.geometry.screw import screw_motion
from articulate_ssl.geometry.se3 import transform_points
from datamodules import atomic
from datamodules.manifest import Manifest, set_folder
from datamodules.shards import read_shard, write_shard
from datamodules.verify import verify_set
from render.category import load_category
from render.execution import run_tasks
from render.generate import main
from render.object_set import default_split

SMALL = ["--states", "3", "--rotations", "2", "--views", "2", "--points", "64", "--resolution", "64"]


def make(out: Path, *options: str, train: int = 2, test: int = 1, category: str = "laptop") -> Path:
    """Make a small set in this process and return its folder."""
    counts = ["--train-instances", str(train), "--test-instances", str(test)]
    view = "partial" if "partial" in options else "complete"
    assert main(["--category", category, "--out", str(out), "--workers", "1", *counts, *SMALL, *options]) == 0
    protocol = ("eap" if "eap" in options else "honest") if view == "partial" else None
    return set_folder(out, category, "procedural", view, protocol)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a set."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_same(found: dict[str, bytes], expected: dict[str, bytes]) -> None:
    """Fails with the first differing array and index of every file."""
    assert sorted(found) == sorted(expected)
    differences = [difference(name, found[name], expected[name]) for name in found if found[name] != expected[name]]
    assert not differences, "\n".join(differences)


def difference(name: str, found: bytes, expected: bytes) -> str:
    """Where two versions of a file differ, in words."""
    if name.endswith(".npz"):
        pair = [np.load(io.BytesIO(content)) for content in (found, expected)]
        for array in pair[1]:
            a, b = (content[array] for content in pair)
            if a.shape != b.shape:
                return f"{name}: {array} has shape {a.shape}, expected {b.shape}"
            if (different := np.argwhere(a != b)).size:
                index = tuple(different[0].tolist())
                return f"{name}: {array}[{index}] is {a[index]!r}, expected {b[index]!r}; {len(different)} differ"
    position = next((i for i, (a, b) in enumerate(zip(found, expected, strict=False)) if a != b), len(expected))
    around = slice(max(0, position - 40), position + 40)
    return f"{name}: byte {position}: {found[around]!r}, expected {expected[around]!r}"


@pytest.fixture(scope="module")
def complete_set(tmp_path_factory) -> Path:
    return make(tmp_path_factory.mktemp("complete"))


def test_splits_hold_what_was_asked_for(complete_set):
    manifest = Manifest.load(complete_set)
    assert manifest.instances == {"train": ("laptop-0000", "laptop-0001"), "test": ("laptop-0002",)}
    assert (manifest.num_samples("train"), manifest.num_samples("test")) == (2 * 3, 1 * 3 * 2)
    assert manifest.part_names == ("base", "lid")
    np.testing.assert_allclose(np.rad2deg(manifest.articulation_range), [[9 - 90, 99 - 90]])
    assert sorted(contents(complete_set)) == sorted(
        ["manifest.json", "test/shard-00000.npz", "train/shard-00000.npz", "train/shard-00001.npz"]
    )


def test_training_clouds_are_stored_once_unrotated_and_test_clouds_rotated(complete_set):
    train = read_shard(complete_set / "train" / "shard-00000.npz")
    test = read_shard(complete_set / "test" / "shard-00000.npz")
    np.testing.assert_array_equal(train["object_rotation"], np.broadcast_to(np.eye(3), (3, 3, 3)))
    assert len(np.unique(test["object_rotation"].reshape(6, 9), axis=0)) == 6
    assert len(np.unique(test["joint_state"])) == 3


@pytest.mark.parametrize(
    ("category", "options"),
    [
        ("laptop", []),
        ("eyeglasses", ["--view", "partial"]),
        ("drawer", []),
        ("drawer", ["--view", "partial", "--protocol", "eap"]),
        ("oven", ["--view", "partial", "--renderer", "ray-caster", "--noise-std", "0.001"]),
        ("safe", []),
        ("washing_machine", ["--view", "partial"]),
        ("laptop_real", []),
        ("desk_lamp", []),
        ("desk_lamp", ["--view", "partial"]),
        ("safe", ["--variant", "both_sides"]),
    ],
)
def test_generated_sets_pass_verification(tmp_path, category, options):
    assert verify_set(make(tmp_path, *options, train=1, category=category)) == []


@pytest.mark.parametrize("options", [[], ["--view", "partial"]])
def test_shards_of_a_serial_chain_name_every_joint_with_its_parent_and_carry_its_children_along(tmp_path, options):
    shard = read_shard(make(tmp_path, *options, train=1, category="desk_lamp") / "train" / "shard-00000.npz")
    samples = len(shard["scale"])
    np.testing.assert_array_equal(shard["joint_parent"], np.broadcast_to([0, 1, 2], (samples, 3)))
    np.testing.assert_array_equal(shard["joint_child"], np.broadcast_to([1, 2, 3], (samples, 3)))
    axis, pivot = (shard[name].astype(float) for name in ("joint_axis", "joint_pivot"))
    np.testing.assert_allclose(axis, np.broadcast_to(axis[:, :1], axis.shape), atol=1e-5)  # parallel in every state
    arms = np.linalg.norm(np.diff(pivot, axis=1), axis=2) * shard["scale"][:, None]
    np.testing.assert_allclose(arms, np.broadcast_to(arms[0], arms.shape), rtol=1e-4)  # links keep their lengths
    # The head has turned by the sum of all three states.
    rotation = shard["part_pose"][:, :, :3, :3].astype(float)
    turned = np.einsum("sba,sbc->sac", rotation[:, 0], rotation[:, 3])
    difference = np.einsum("ba,sbc->sac", turned[0], turned)
    angle = np.arccos(np.clip((np.trace(difference, axis1=1, axis2=2) - 1) / 2, -1, 1))
    states = shard["joint_state"].astype(float).sum(1)
    np.testing.assert_allclose(angle, np.abs(states - states[0]), atol=2e-3)


def test_a_variant_is_recorded_and_not_mixed_with_others(tmp_path, capsys):
    folder = make(tmp_path, "--variant", "both_sides", category="safe")
    assert Manifest.load(folder).options["variant"] == "both_sides"
    counts = ["--train-instances", "2", "--test-instances", "1"]
    assert main(["--category", "safe", "--out", str(tmp_path), "--workers", "1", *counts, *SMALL]) == 2
    assert "variant 'both_sides', now None" in capsys.readouterr().err
    assert main(["--category", "oven", "--out", str(tmp_path), "--variant", "both_sides"]) == 2
    assert "'oven' has no variant 'both_sides'" in capsys.readouterr().err


def test_doors_are_as_far_open_as_asked_for_and_not_mixed_with_others(tmp_path, capsys):
    folder = make(tmp_path, "--range-deg", "0", "30", category="oven")
    state = np.rad2deg(read_shard(folder / "train" / "shard-00000.npz")["joint_state"])
    assert state.min() >= -1e-4 and state.max() < 30
    assert Manifest.load(folder).options["range_deg"] == [0, 30]
    counts = ["--train-instances", "2", "--test-instances", "1", "--workers", "1", *SMALL]
    assert main(["--category", "oven", "--out", str(tmp_path), *counts]) == 2
    assert "range_deg [0.0, 30.0], now None" in capsys.readouterr().err
    assert main(["--category", "drawer", "--out", str(tmp_path), "--range-deg", "0", "30"]) == 2
    assert "'drawer' has no hinges of its own" in capsys.readouterr().err


def test_moving_a_part_about_its_joint_lands_on_the_cloud_of_another_state(complete_set):
    """Every point of one state's cloud, moved by the state difference, lies on the surface the other cloud samples."""
    shard = {
        name: torch.tensor(array) for name, array in read_shard(complete_set / "train" / "shard-00000.npz").items()
    }
    pose = shard["part_pose"].double()
    a, b = 0, 1
    lid = shard["part_id"][a] == 1
    difference = (shard["joint_state"][b] - shard["joint_state"][a])[0].double()
    axis, pivot = shard["joint_axis"][a, 0].double(), shard["joint_pivot"][a, 0].double()
    moved = transform_points(screw_motion(axis, pivot, difference, 0), shard["points"][a][lid].double())
    base_motion = pose[b, 0] @ torch.linalg.inv(pose[a, 0])
    in_other = transform_points(base_motion, moved)
    rest = transform_points(torch.linalg.inv(pose[b, 1]), in_other)
    expected = transform_points(torch.linalg.inv(pose[a, 1]), shard["points"][a][lid].double())
    torch.testing.assert_close(rest, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("workers", "options"), [("2", ["--view", "partial"]), ("3", [])])
def test_bytes_do_not_depend_on_the_number_of_workers(tmp_path, workers, options):
    expected = contents(make(tmp_path / "1", *options))
    assert_same(contents(make(tmp_path / workers, *options, "--workers", workers)), expected)


def test_another_seed_gives_other_bytes(tmp_path, complete_set):
    assert (
        contents(make(tmp_path, "--seed", "1"))["train/shard-00000.npz"]
        != contents(complete_set)["train/shard-00000.npz"]
    )


def test_dask_makes_the_same_bytes(tmp_path, complete_set):
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, processes=False) as cluster:
        folder = make(tmp_path, "--scheduler", cluster.scheduler_address)
    assert_same(contents(folder), contents(complete_set))


def test_a_difference_is_named_by_array_and_index(tmp_path, complete_set):
    expected = contents(complete_set)
    name = "train/shard-00000.npz"
    arrays = {key: array.copy() for key, array in read_shard(complete_set / name).items()}
    arrays["points"][1, 2, 0] = 5
    write_shard(tmp_path / "shard.npz", arrays)
    with pytest.raises(AssertionError, match=rf"{name}: points\[\(1, 2, 0\)\] is .*5.*; 1 differ"):
        assert_same(expected | {name: (tmp_path / "shard.npz").read_bytes()}, expected)
    with pytest.raises(AssertionError, match=r"manifest.json: byte 0: b'x"):
        assert_same(expected | {"manifest.json": b"x"}, expected)


def test_unreachable_scheduler_is_a_clear_error(tmp_path, capsys):
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        code = main(["--category", "laptop", "--out", str(tmp_path), "--scheduler", "tcp://127.0.0.1:1", *SMALL])
    assert code == 2 and "tcp://127.0.0.1:1" in capsys.readouterr().err


def test_killed_runs_resume_to_the_same_bytes(tmp_path):
    """SIGKILL at several moments; no file under a final name is ever half written, and no worker lives on."""
    options = ("--points", "512", "--workers", "2")
    expected = contents(make(tmp_path / "whole", "--points", "512", train=6))
    forkserver.ensure_running()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["render.generate", "render.sources.procedural"])
    bystanders = set(psutil.Process().children(recursive=True))
    folder, kills = set_folder(tmp_path / "killed", "laptop"), 0
    for delay in (0.05, 0.5, 1.0):
        process = context.Process(target=make, args=(tmp_path / "killed", *options), kwargs={"train": 6})
        process.start()
        wait_for(folder / ".journal.jsonl", process)
        time.sleep(delay)
        if process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        workers = set(psutil.Process().children(recursive=True)) - bystanders
        process.join()
        assert psutil.wait_procs(workers, timeout=30)[1] == []
        found = contents(folder)
        assert all(found[name] == expected[name] for name in found if not Path(name).name.startswith("."))
    assert kills > 0
    make(tmp_path / "killed", *options, train=6)
    assert_same(contents(folder), expected)  # and nothing else is left behind


def wait_for(path: Path, process: multiprocessing.Process) -> None:
    """Until a file appears, or the process that should write it has ended."""
    while process.is_alive() and not path.exists():
        time.sleep(0.01)


def test_two_runs_in_one_folder_are_refused(tmp_path, capsys):
    folder = set_folder(tmp_path, "laptop")
    folder.mkdir(parents=True)
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert main(["--category", "laptop", "--out", str(tmp_path), *SMALL]) == 2
    assert "another run is making this set" in capsys.readouterr().err
    os.close(descriptor)


def test_a_killed_worker_is_a_clear_error(tmp_path):
    tasks = [KillingTask()] * 2
    with pytest.raises(ChildProcessError, match="worker process was killed"):
        list(run_tasks(tasks, workers=2))


class KillingTask:
    """Ends the worker that unpacks it, as the kernel does when memory runs out."""

    def __reduce__(self):
        return os._exit, (9,)


def test_an_unfinished_set_keeps_what_is_done(tmp_path, complete_set, monkeypatch):
    """Only the shards that are missing or damaged are made again."""
    folder = set_folder(tmp_path, "laptop")
    shutil.copytree(complete_set, folder)
    shard = folder / "train" / "shard-00001.npz"
    shard.write_bytes(shard.read_bytes()[:-1])
    (folder / "test" / "shard-00000.npz").unlink()
    untouched = (folder / "train" / "shard-00000.npz").stat().st_mtime_ns
    make(tmp_path)
    assert_same(contents(folder), contents(complete_set))
    assert (folder / "train" / "shard-00000.npz").stat().st_mtime_ns == untouched


def test_a_torn_journal_line_is_made_again(tmp_path, complete_set):
    make(tmp_path)
    folder = set_folder(tmp_path, "laptop")
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").unlink()
    header = {"generator_version": manifest["generator_version"], **manifest["options"]}
    (folder / ".journal.jsonl").write_text(json.dumps(header) + '\n{"split": "train", "na')
    (folder / "train" / ".shard-00000.npz.0123.tmp").write_bytes(b"left by a killed run")
    make(tmp_path)
    assert_same(contents(folder), contents(complete_set))


def begin(complete_set: Path, out: Path, journal: bytes) -> Path:
    """Copy a set as if its run had been interrupted before the manifest, with such a journal."""
    folder = set_folder(out, "laptop")
    shutil.copytree(complete_set, folder)
    (folder / "manifest.json").unlink()
    (folder / ".journal.jsonl").write_bytes(journal)
    return folder


@pytest.mark.parametrize("journal", [b"", b"5\n", b"\xff\xfe\x00", b"[]\n"])
def test_a_journal_without_a_readable_line_is_begun_anew(tmp_path, complete_set, journal):
    folder = begin(complete_set, tmp_path, journal)
    make(tmp_path)
    assert_same(contents(folder), contents(complete_set))


def test_damaged_lines_of_a_journal_are_skipped_but_for_the_first(tmp_path, complete_set, capsys):
    manifest = json.loads((complete_set / "manifest.json").read_text())
    header = json.dumps({"generator_version": manifest["generator_version"], **manifest["options"]}).encode()
    folder = begin(complete_set, tmp_path, header + b'\n5\n{"split": "train"}\n\xff\n')
    make(tmp_path)
    assert_same(contents(folder), contents(complete_set))
    begin(complete_set, tmp_path / "other", b'5\n{"split": "train"}\n')
    assert main(["--category", "laptop", "--out", str(tmp_path / "other"), *SMALL]) == 2
    message = capsys.readouterr().err
    assert ".journal.jsonl: is damaged" in message and "delete it" in message


def test_other_options_in_the_same_folder_are_refused(tmp_path, complete_set, capsys):
    out = complete_set.parents[1]
    before = contents(complete_set)
    assert main(["--category", "laptop", "--out", str(out), "--seed", "5", *SMALL]) == 2
    message = capsys.readouterr().err
    assert str(complete_set) in message and "seed 0, now 5" in message and "delete that folder" in message
    assert contents(complete_set) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--category", "toaster"], "unknown category 'toaster'"),
        (["--category", "laptop", "--states", "0"], "must be at least 1"),
        (["--category", "laptop", "--states", "many"], "invalid integer value: 'many'"),
        (["--category", "laptop", "--noise-std", "-1"], "--noise-std must be in [0, 1)"),
        (["--category", "laptop", "--noise-std", "nan"], "--noise-std must be in [0, 1)"),
        (["--category", "laptop", "--root", "somewhere"], "takes no --root"),
        (["--category", "laptop", "--source", "urdf"], "needs a --root"),
        (["--category", "laptop", "--source", "urdf", "--root", "/no/such/folder"], "/no/such/folder"),
        (["--category", "laptop", "--train-instances", "0", "--test-instances", "0"], "nothing to make"),
        (["--category", "laptop", "--train-instances", "99999999"], "has 10000 instances"),
        (["--category", "laptop", "--points", "32769"], "--points must be at most 32768 of complete clouds, not 32769"),
    ],
)
def test_bad_arguments_exit_with_2_and_one_message(tmp_path, capsys, options, message):
    try:
        code = main([*options, "--out", str(tmp_path), "--workers", "1"])
    except SystemExit as exit:
        code = exit.code
    assert code == 2
    assert message in capsys.readouterr().err


def test_output_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    assert main(["--category", "laptop", "--out", str(tmp_path / "file"), *SMALL]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_full_disk_keeps_what_is_done_and_can_be_continued(tmp_path, complete_set, monkeypatch, capsys):
    fsync, calls = os.fsync, []

    def full_after_the_journal_and_one_shard(descriptor):
        calls.append(descriptor)
        if len(calls) > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(atomic.os, "fsync", full_after_the_journal_and_one_shard)
    folder = set_folder(tmp_path, "laptop")
    counts = ["--train-instances", "2", "--test-instances", "1"]
    assert main(["--category", "laptop", "--out", str(tmp_path), "--workers", "1", *counts, *SMALL]) == 2
    assert "No space left on device" in capsys.readouterr().err
    shards = {name for name in contents(folder) if name.endswith(".npz")}
    assert shards == {"train/shard-00000.npz"} and not (folder / "manifest.json").exists()
    monkeypatch.undo()
    make(tmp_path)
    assert_same(contents(folder), contents(complete_set))


def test_without_egl_the_ray_caster_takes_over_and_says_so(tmp_path):
    """PyOpenGL is pointed to a platform that is not installed, as where libEGL is missing."""
    environment = os.environ | {"PYOPENGL_PLATFORM": "osmesa"}
    command = [sys.executable, "-m", "render.generate", "--category", "laptop", "--view", "partial", *SMALL]
    command += ["--workers", "1", "--train-instances", "1", "--test-instances", "0", "--out", str(tmp_path)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert "no offscreen OpenGL" in run.stderr and "ray caster" in run.stderr
    folder = set_folder(tmp_path, "laptop", "procedural", "partial", "honest")
    assert Manifest.load(folder).options["renderer"] == "ray-caster"
    run = subprocess.run([*command, "--renderer", "egl"], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 2 and "--renderer ray-caster" in run.stderr and "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("available", "expected"), [(100, (73, 9)), (82, (73, 9)), (41, (37, 4)), (2, (1, 1)), (1, (0, 1))]
)
def test_small_collections_are_split_in_the_same_ratio(available, expected):
    assert default_split(load_category("laptop"), available) == expected
