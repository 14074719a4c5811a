"""The npz shard format: determinism, atomicity, and one clear error for every kind of damage."""

from __future__ import annotations

import errno
import os
import zipfile

import numpy as np
import pytest
from synthetic import synthetic_arrays

from datamodules.shards import (
    ALIGNMENT,
    SHARD_ARRAYS,
    UNLABELLED_ARRAYS,
    ShardError,
    read_shard,
    sha256_of,
    write_shard,
)


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    return synthetic_arrays([(0, np.array([1.0, 0.8, 0.2]))], 3, 2, 32, True, np.random.default_rng(0))


def test_arrays_survive_the_round_trip_mapped_aligned_and_read_only(tmp_path, arrays):
    sha256 = write_shard(tmp_path / "a.npz", arrays)
    loaded = read_shard(tmp_path / "a.npz", sha256)
    assert list(loaded) == list(SHARD_ARRAYS)
    for name, array in loaded.items():
        np.testing.assert_array_equal(array, arrays[name])
        assert array.ctypes.data % ALIGNMENT == 0
        assert not array.flags.writeable


def test_numpy_reads_it_without_pickle(tmp_path, arrays):
    write_shard(tmp_path / "a.npz", arrays)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as loaded:
        for name, array in arrays.items():
            np.testing.assert_array_equal(loaded[name], array)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_files_of_other_writers_are_read(tmp_path, arrays, save):
    save(tmp_path / "a.npz", **arrays)
    for name, array in read_shard(tmp_path / "a.npz").items():
        np.testing.assert_array_equal(array, arrays[name])


def test_bytes_depend_on_the_arrays_alone(tmp_path, arrays):
    first = write_shard(tmp_path / "a.npz", arrays)
    strided = {name: np.asfortranarray(arrays[name]) for name in reversed(arrays)}
    assert write_shard(tmp_path / "b.npz", strided) == first == sha256_of(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    changed = arrays | {"scale": np.nextafter(arrays["scale"], np.float32(9))}
    assert write_shard(tmp_path / "c.npz", changed) != first


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("scale"), "'scale' is missing"),
        (lambda a: a.update(colour=a["scale"]), "'colour' is unknown"),
        (lambda a: a.update(points=a["points"].astype(np.float64)), "'points' has dtype float64, expected float32"),
        (lambda a: a.update(part_id=a["part_id"][:, :5]), r"'part_id' has shape \[6, 5\], expected \[6, 32\]"),
        (lambda a: a.update(center=a["center"][:, :2]), r"'center' has shape \[6, 2\], expected \[6, 3\]"),
        (lambda a: a.update(scale=a["scale"][:, None]), r"'scale' has shape \[6, 1\], expected \[6\]"),
        (lambda a: a.update(center=a["center"] * np.float32("nan")), "'center' has NaN"),
        (lambda a: a.update({n: x[:0] for n, x in a.items()}), "size S is zero"),
    ],
)
def test_writing_arrays_off_the_schema_is_refused_and_leaves_nothing(tmp_path, arrays, change, message):
    change(arrays)
    with pytest.raises(ShardError, match=rf"a.npz: .*{message}"):
        write_shard(tmp_path / "a.npz", arrays)
    assert list(tmp_path.iterdir()) == []


def test_reading_a_file_off_the_schema_names_file_and_array(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", **{name: array for name, array in arrays.items() if name != "joint_axis"})
    with pytest.raises(ShardError, match=r"a.npz: .*'joint_axis' is missing.*make data"):
        read_shard(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **arrays | {"scale": arrays["scale"].astype(np.float16)})
    with pytest.raises(ShardError, match=r"b.npz: .*'scale' has dtype float16"):
        read_shard(tmp_path / "b.npz")


def test_pickled_objects_are_never_loaded(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", **arrays | {"scale": np.array([print] * 6, dtype=object)})
    with pytest.raises(ShardError, match=r"a.npz: .*objects"):
        read_shard(tmp_path / "a.npz")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_truncated_shard_is_named(tmp_path, arrays, share):
    path = tmp_path / "a.npz"
    sha256 = write_shard(path, arrays)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    for expected in (sha256, None):
        with pytest.raises(ShardError, match=r"a.npz: shard is damaged.*make data"):
            read_shard(path, expected)


def test_a_flipped_bit_is_named(tmp_path, arrays):
    path = tmp_path / "a.npz"
    sha256 = write_shard(path, arrays)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ShardError, match=r"a.npz: shard is damaged.*make data"):
        read_shard(path, sha256)


def test_random_damage_is_either_named_or_leaves_the_structure_intact(tmp_path, arrays):
    """Without a checksum the arrays themselves may differ, but nothing other than a ShardError escapes."""
    path = tmp_path / "a.npz"
    small = {name: array[:1, :2] if name in ("points", "part_id") else array[:1] for name, array in arrays.items()}
    sha256 = write_shard(path, small)
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    named = 0
    for _ in range(400):
        damaged = bytearray(content)
        damaged[generator.integers(len(content))] ^= 1 << generator.integers(8)
        path.write_bytes(damaged)
        with pytest.raises(ShardError, match=r"a\.npz"):
            read_shard(path, sha256)
        try:
            assert {name: array.shape for name, array in read_shard(path).items()} == {
                n: a.shape for n, a in small.items()
            }
        except ShardError as error:
            named += "a.npz" in str(error)
    assert named > 100


def test_an_array_that_claims_to_reach_beyond_the_file_is_named(tmp_path, arrays):
    path = tmp_path / "a.npz"
    write_shard(path, arrays)
    with zipfile.ZipFile(path) as archive:
        last = archive.infolist()[-1]
    content = bytearray(path.read_bytes())
    shape = content.index(b"(6,), }  ", last.header_offset)
    content[shape : shape + 9] = b"(699,), }"
    path.write_bytes(content)
    with pytest.raises(ShardError, match=r"a.npz: shard is damaged"):
        read_shard(path)


def test_a_missing_shard_is_named(tmp_path):
    with pytest.raises(ShardError, match=r"a.npz: shard is missing.*make data"):
        read_shard(tmp_path / "a.npz")


def test_a_failing_write_keeps_the_old_file_and_leaves_no_other(tmp_path, arrays, monkeypatch):
    path = tmp_path / "a.npz"
    sha256 = write_shard(path, arrays)

    def full_disk(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_shard(path, arrays | {"scale": arrays["scale"] * 2})
    assert [sha256_of(p) for p in tmp_path.iterdir()] == [sha256]


def test_a_shard_has_all_labels_or_none(tmp_path, arrays):
    unlabelled = {name: arrays[name] for name in UNLABELLED_ARRAYS}
    sha256 = write_shard(tmp_path / "a.npz", unlabelled)
    assert tuple(read_shard(tmp_path / "a.npz", sha256)) == UNLABELLED_ARRAYS
    with pytest.raises(ShardError, match="'part_id' is missing"):
        write_shard(tmp_path / "b.npz", unlabelled | {"joint_axis": arrays["joint_axis"]})
    with pytest.raises(ShardError, match="'instance' is missing"):
        write_shard(tmp_path / "b.npz", {"points": arrays["points"]})
