"""`python -m datamodules.scans`: a shard's clouds come back as they were before they were normalised."""

from __future__ import annotations

import numpy as np
import pytest
from unlabelled import without_labels

from datamodules.point_cloud_io import read_scan
from datamodules.scans import WRITERS, main, write_scans
from datamodules.shards import read_shard


def clouds(shard) -> np.ndarray:
    """Of a shard, in the unit of its source."""
    arrays = read_shard(shard)
    return arrays["points"] * arrays["scale"][:, None, None] + arrays["center"][:, None]


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("labelled", [True, False])
def test_every_cloud_is_read_back_in_the_unit_of_its_source(tmp_path, synthetic_set, suffix, labelled):
    shard = (synthetic_set if labelled else without_labels(synthetic_set)) / "train" / "shard-00001.npz"
    expected = clouds(shard)
    assert np.abs(expected - read_shard(shard)["points"]).max() > 0.1  # or a normalised cloud would pass
    files = write_scans(shard, tmp_path / "new" / "scans", suffix)
    assert [file.suffix for file in files] == [suffix] * len(expected)
    assert sorted(files) == files
    for file, cloud in zip(files, expected, strict=True):
        np.testing.assert_allclose(read_scan(file).points, cloud, atol=1e-5)


def test_two_shards_fit_into_one_folder(tmp_path, synthetic_set, capsys):
    shards = sorted((synthetic_set / "train").glob("*.npz"))[:2]
    assert [main([str(shard), str(tmp_path / "scans")]) for shard in shards] == [0, 0]
    assert len(list((tmp_path / "scans").iterdir())) == sum(len(clouds(shard)) for shard in shards)
    assert f"{tmp_path / 'scans'}: {len(clouds(shards[1]))} scans, {shards[1].stem}-0000.npy" in capsys.readouterr().out


def test_a_shard_that_cannot_be_read_is_named(tmp_path, synthetic_set, capsys):
    shard = synthetic_set / "train" / "shard-00000.npz"
    shard.write_bytes(shard.read_bytes()[:-10])
    assert main([str(shard), str(tmp_path / "scans")]) == 2
    assert main([str(tmp_path / "no.npz"), str(tmp_path / "scans")]) == 2
    damaged, missing = capsys.readouterr().err.splitlines()
    assert str(shard) in damaged
    assert f"{tmp_path / 'no.npz'}: shard is missing" in missing
    assert not (tmp_path / "scans").exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path, synthetic_set, capsys):
    (tmp_path / "file").touch()
    assert main([str(synthetic_set / "train" / "shard-00000.npz"), str(tmp_path / "file" / "scans")]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
