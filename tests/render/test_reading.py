"""External sources are read whole: every broken object is named at once, and left out only if that is asked for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from dataset_writers import (
    LAPTOP_BASE,
    LID,
    LID_HINGE,
    hoi4d_safe,
    motion_node,
    partnet_safe,
    urdf_joint,
    urdf_link,
    write_shape2motion,
    write_urdf,
)

from datamodules.manifest import Manifest
from render.generate import main
from render.reading import broken
from render.shard_task import Reading

SMALL = ["--states", "2", "--rotations", "1", "--points", "64", "--workers", "1"]


def partnet(root: Path) -> dict[str, str]:
    """Five safes, three of them broken; by id a word about each of these."""
    for name in ("1", "2", "3", "4", "5"):
        partnet_safe(root / name)
    (root / "2" / "meta.json").write_text("{")
    (root / "3" / "semantics.txt").write_text("link_0 heavy\n")
    (root / "5" / "textured_objs" / "original-1.obj").unlink()
    return {"2": "meta.json: not valid JSON", "3": "semantics.txt: line", "5": "original-1.obj"}


def hoi4d(root: Path) -> dict[str, str]:
    """Three safes, one of them broken."""
    for name in ("001", "002", "003"):
        hoi4d_safe(root / "Safe" / name)
    (root / "Safe" / "002" / "mobility_v2.json").write_text("[{}]")
    return {"002": "mobility_v2.json: node 0 is malformed"}


def shape2motion(root: Path) -> dict[str, str]:
    """Three laptops, one of them broken."""
    tree = motion_node("base", "none", children=[motion_node("lid", "rotation", LID_HINGE, (1, 0, 0))])
    for name in ("0001", "0002", "0003"):
        write_shape2motion(root / "laptop" / name, tree, {"base": LAPTOP_BASE, "lid": LID})
    (root / "laptop" / "0003" / "part_objs" / "lid.obj").write_text("v 0 0 0\n")
    return {"0003": "lid.obj"}


def urdf(root: Path) -> dict[str, str]:
    """Two boxes with a lid, one without a joint and one that is no XML."""
    hinge = urdf_joint("hinge", "base", "lid", extra='<origin xyz="0 0 .6"/>')
    body = urdf_link("base") + urdf_link("lid", "1 1 .1") + hinge
    for name in ("a", "b"):
        write_urdf(root / f"{name}.urdf", body)
    write_urdf(root / "d.urdf", urdf_link("base"))
    (root / "e.urdf").write_text("<robot")
    return {"d": "d.urdf: no joint moves", "e": "e.urdf"}


CASES = [
    (partnet, "partnet-mobility", "safe", 2),
    (hoi4d, "hoi4d", "safe", 2),
    (shape2motion, "shape2motion", "laptop", 2),
    (urdf, "urdf", "articulated", 2),
]


@pytest.mark.parametrize(("write", "source", "category", "sound"), CASES, ids=[case[1] for case in CASES])
def test_all_broken_objects_are_named_at_once_and_can_be_left_out(tmp_path, capsys, write, source, category, sound):
    words = write(tmp_path / "root")
    command = ["--category", category, "--source", source, "--root", str(tmp_path / "root"), *SMALL]
    command += ["--out", str(tmp_path / "out")]
    assert main(command) == 2
    message = capsys.readouterr().err
    assert f"{len(words)} of {len(words) + sound} objects" in message and "--skip-broken" in message
    for name, word in words.items():
        assert sum(word in line for line in message.splitlines()) == 1, name
    assert not (tmp_path / "out").exists()

    assert main([*command, "--skip-broken"]) == 0
    screen = capsys.readouterr().err
    (folder,) = (tmp_path / "out" / category).iterdir()
    manifest = Manifest.load(folder)
    for name, word in words.items():
        assert manifest.left_out[name].startswith("broken: ") and word in manifest.left_out[name]
        assert word in screen
    assert str(tmp_path) not in json.dumps(manifest.left_out)  # wherever the folder lies
    used = {name for ids in manifest.instances.values() for name in ids}
    assert len(used) + len(manifest.left_out) == len(words) + sound and not used & set(words)
    before = (folder / "manifest.json").read_bytes()
    assert main([*command, "--skip-broken"]) == 0  # found complete
    assert (folder / "manifest.json").read_bytes() == before


def test_a_folder_in_which_all_is_broken_is_refused_whatever_is_skipped(tmp_path, capsys):
    urdf(tmp_path / "root")
    for name in ("a", "b"):
        shutil.copy(tmp_path / "root" / "d.urdf", tmp_path / "root" / f"{name}.urdf")
    command = ["--category", "articulated", "--source", "urdf", "--root", str(tmp_path / "root"), *SMALL]
    assert main([*command, "--out", str(tmp_path / "out"), "--skip-broken"]) == 2
    message = capsys.readouterr().err
    assert "4 of 4 objects" in message and "--skip-broken" not in message


def test_an_object_that_no_camera_can_see_is_found_before_anything_is_made(tmp_path, capsys):
    inside = urdf_link("base") + urdf_link("lid", ".1 .1 .1") + urdf_joint("slide", "base", "lid", "prismatic")
    inside = inside.replace('upper="1"', 'upper="0.1"')
    write_urdf(tmp_path / "root" / "hidden.urdf", inside)
    urdf(tmp_path / "root")
    command = ["--category", "articulated", "--source", "urdf", "--root", str(tmp_path / "root"), *SMALL]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert "no sensor reaches part 'lid'" in capsys.readouterr().err


def test_a_problem_that_names_nothing_gets_the_name_of_its_object():
    readings = {"a": Reading("a", "is hollow"), "b": Reading("b")}
    with pytest.raises(ValueError, match=r"1 of 2 objects in there.*\n  a: is hollow"):
        broken(readings, "there", "objects", skip=False)
    assert broken(readings, "there", "objects", skip=True) == {"a": "broken: is hollow"}


def test_an_object_is_named_also_if_its_name_is_a_letter_of_the_message(tmp_path):
    readings = {
        "o": Reading("o", "laptop instance: a sensor reaches only 1 point"),
        "a": Reading("a", "laptop/a.urdf: bad"),
        "b": Reading("b"),
    }
    with pytest.raises(ValueError, match=r"\n  o: laptop instance: a sensor.*\n  laptop/a\.urdf: bad"):
        broken(readings, "laptop", "objects", skip=False)
    with pytest.raises(ValueError, match=r"\n  one\.urdf: bad"):
        broken({"one": Reading("one", "one.urdf: bad")}, "one.urdf", "objects", skip=False)


def add(root: Path) -> str:
    shutil.copy(root / "a.urdf", root / "aa.urdf")
    return "added: aa"


def edit(root: Path) -> str:
    file = root / "a.urdf"
    file.write_text(file.read_text().replace('upper="1"', 'upper="0.5"'))
    return "changed: a"


def exchange(root: Path) -> str:
    (root / "b.urdf").rename(root / "c.urdf")
    return "added: c; removed: b"


@pytest.mark.parametrize("change", [add, edit, exchange])
@pytest.mark.parametrize("finished", [True, False])
def test_a_set_of_other_objects_is_not_gone_on_with(tmp_path, monkeypatch, capsys, change, finished):
    urdf(tmp_path / "root")
    for name in "de":
        (tmp_path / "root" / f"{name}.urdf").unlink()
    command = ["--category", "articulated", "--source", "urdf", "--root", str(tmp_path / "root"), *SMALL]
    command += ["--out", str(tmp_path / "out"), "--train-instances", "1", "--test-instances", "1"]
    with monkeypatch.context() as patch:
        if not finished:
            patch.setattr(Manifest, "save", interrupt)
        assert main(command) == (0 if finished else 130)
    difference = change(tmp_path / "root")
    assert main(command) == 2
    assert difference in capsys.readouterr().err


def interrupt(*_) -> None:
    raise KeyboardInterrupt
