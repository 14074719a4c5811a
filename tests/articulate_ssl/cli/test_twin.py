"""`articulate-ssl twin`: from scans of one object to a folder of results."""

import json

import numpy as np
import pytest
from twin_objects import drawer, scans, true_object

from articulate_ssl.cli import main
from articulate_ssl.inference import twin


@pytest.fixture
def scan_files(tmp_path, monkeypatch):
    monkeypatch.setattr(twin, "find_one_object", true_object)  # found for real in tests/articulate_ssl/inference
    monkeypatch.chdir(tmp_path)
    names = [f"{i}.npy" for i in range(8)]
    for name, cloud in zip(names, scans(drawer()), strict=True):
        np.save(name, cloud)
    return names


def test_scans_become_a_folder(scan_files, tmp_path, capsys):
    assert main(["twin", *scan_files, "--parts", "2", "--joint", "prismatic", "--html"]) == 0
    out = capsys.readouterr().out
    assert "joint states" in out and "7.npy" in out
    assert {"prediction.json", "object.urdf", "object.glb", "states.json", "view.html"} <= {
        path.name for path in (tmp_path / "twin").iterdir()
    }
    assert list(json.loads((tmp_path / "twin" / "states.json").read_text())) == scan_files


def test_scans_of_one_name_are_told_apart_by_their_folders(scan_files, tmp_path, capsys, monkeypatch):
    given = []
    monkeypatch.setattr(twin.Twin, "export", lambda self, folder, names: given.extend(names) or [])
    paths = [f"state{i}/scan.npy" for i in range(8)]
    for name, path in zip(scan_files, paths, strict=True):
        (tmp_path / path).parent.mkdir()
        (tmp_path / name).rename(tmp_path / path)
    assert main(["twin", *paths, "--parts", "2", "--joint", "prismatic"]) == 0
    assert given == paths
    out = capsys.readouterr().out
    assert all(path in out for path in paths)


def test_a_scan_that_is_given_twice_is_refused(scan_files, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["twin", *scan_files, "./3.npy", "--parts", "2"])
    assert "3.npy: given more than once" in capsys.readouterr().err


def test_a_folder_that_is_a_file_is_refused_first(scan_files, capsys, monkeypatch):
    monkeypatch.setattr(twin, "find_one_object", None)
    assert main(["twin", *scan_files, "--parts", "2", "--out", "0.npy"]) == 2
    assert "0.npy is a file; name another folder" in capsys.readouterr().err


def test_too_few_scans_are_refused(scan_files, tmp_path, capsys, monkeypatch):
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert main(["twin", *scan_files[:3], "--parts", "2"]) == 2
    assert "3 clouds of one object, at least 8 are needed" in capsys.readouterr().err
    assert not (tmp_path / "twin").exists()


def test_a_damaged_scan_is_named(scan_files, tmp_path, capsys):
    (tmp_path / "bad.npy").write_bytes(b"no numbers")
    assert main(["twin", *scan_files, "bad.npy", "--parts", "2"]) == 2
    assert "bad.npy: damaged" in capsys.readouterr().err


def test_one_part_does_not_move(scan_files):
    with pytest.raises(SystemExit, match="2"):
        main(["twin", *scan_files, "--parts", "1"])
