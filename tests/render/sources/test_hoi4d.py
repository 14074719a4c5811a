import json

import numpy as np
import pytest
from dataset_writers import (
    CABINET,
    DOOR,
    HINGE,
    KNOB,
    LAPTOP_BASE,
    LID,
    LID_HINGE,
    TO_Z_UP,
    hinge_data,
    hoi4d_safe,
    write_mobility_v2,
)

from render.category import load_category
from render.sources import open_source
from render.sources.hoi4d import read_mobility_v2

FRONT_TO_MINUS_X = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ TO_Z_UP


def load(root, category, instance_id):
    return open_source("hoi4d", load_category(category), root, 0).load(instance_id)


@pytest.mark.parametrize("rotation", [TO_Z_UP, FRONT_TO_MINUS_X])
@pytest.mark.parametrize("place", ["articulated/Safe", "HOI4D_CAD_Model_for_release/articulated/Safe", "safe"])
def test_safe_is_turned_to_y_up_and_front_to_z(tmp_path, rotation, place):
    hoi4d_safe(tmp_path / place / "003", rotation)
    safe = load(tmp_path, "safe", "003")
    np.testing.assert_allclose(safe.meshes[0].bounds, CABINET.bounds, atol=1e-9)
    np.testing.assert_allclose(safe.meshes[1].bounds[0], DOOR.bounds[0], atol=1e-9)
    np.testing.assert_allclose(safe.meshes[1].bounds[1], KNOB.bounds[1].clip(DOOR.bounds[1]), atol=1e-9)
    (door,) = safe.joints
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(np.cross(door.pivot - HINGE, door.axis), 0, atol=1e-9)
    np.testing.assert_allclose((door.lower, door.upper, door.rest), (0, np.deg2rad(104.76), 0), atol=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "lower", "upper", "sign"),
    [
        (0, -104.76, 0, 1.828407, -1),
        (-30, 90, -0.523599, 1.570796, 1),
        (-226, -403.2, -2.338741, 0.753982, -1),  # the wrapped limits of PartNet-Mobility 10040
        (400, 450, 0.698132, 1.570796, 1),
    ],
)
def test_limits_in_degrees_reversed_and_wrapped(tmp_path, a, b, lower, upper, sign):
    folder = hoi4d_safe(tmp_path / "003", limits=(a, b))
    hinge = read_mobility_v2(folder).movable()[0]
    np.testing.assert_allclose((hinge.lower, hinge.upper), (lower, upper), atol=1e-6)
    np.testing.assert_allclose(hinge.axis, [0, 0, sign], atol=1e-12)


def test_no_limit_leaves_the_range_to_the_category(tmp_path):
    hoi4d_safe(tmp_path / "003", no_limit=True)
    spec = load_category("safe")
    safe = load(tmp_path, "safe", "003")
    np.testing.assert_allclose(safe.joints[0].axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(spec.sampled_ranges(safe), [(np.pi / 4, 3 * np.pi / 4)])


def test_junk_is_dropped_and_aligned_meshes_are_not_read(tmp_path):
    graph = read_mobility_v2(hoi4d_safe(tmp_path / "003"))
    assert [link.name for link in graph.links] == ["base", "link_0", "link_2", "link_3"]
    assert max(np.abs(link.mesh.bounds).max() for link in graph.links[1:]) <= 1


def test_slider_english_names_null_children_and_nested_parts(tmp_path):
    data = {
        "axis": {"origin": [0, 0, 0], "direction": [0, -0.1, 0]},
        "limit": {"a": 0, "b": 0.4, "noLimit": False, "rotates": True, "rotationLimit": 3},
    }
    nodes = [
        {"id": 3, "parent": -1, "joint": "静态", "name": "body", "parts": [2], "jointData": {}},
        {"id": 7, "parent": 3, "joint": "滑动", "name": "box", "parts": [1], "jointData": data},
    ]
    folder = write_mobility_v2(tmp_path / "001", nodes, {2: [CABINET], 4: [DOOR], 5: [KNOB]}, TO_Z_UP)
    tree = [
        {"id": 2, "objs": ["new-0"], "children": None},
        {"id": 1, "children": [{"id": 4, "objs": ["new-1", "new-1-align"]}, {"id": 5, "objs": ["new-2"]}]},
    ]
    (folder / "result.json").write_text(json.dumps(tree))
    chest = load(tmp_path, "articulated", "001")
    (slide,) = chest.joints
    np.testing.assert_allclose(slide.axis, [0, 0, 1], atol=1e-12)
    assert (slide.lower, slide.upper) == (0, 0.4)
    assert len(chest.meshes[1].faces) == len(DOOR.faces) + len(KNOB.faces)
    english = (
        (folder / "mobility_v2.json").read_text(encoding="utf-8").replace("静态", "heavy").replace("滑动", "slider+")
    )
    (folder / "mobility_v2.json").write_text(english)
    np.testing.assert_array_equal(load(tmp_path, "articulated", "001").joints[0].axis, slide.axis)


@pytest.mark.parametrize("category", ["laptop", "laptop_real"])
def test_laptop_closed_at_its_upper_limit(tmp_path, category):
    data = hinge_data(TO_Z_UP @ LID_HINGE, [1, 0, 0], 90, -40)
    nodes = [
        {"id": 0, "parent": -1, "joint": "自由", "name": "keyboard", "parts": [2], "jointData": {}},
        {"id": 1, "parent": 0, "joint": "铰链（旋转）", "name": "display", "parts": [3], "jointData": data},
    ]
    write_mobility_v2(tmp_path / "Laptop/012", nodes, {2: [LAPTOP_BASE], 3: [LID]}, TO_Z_UP)
    laptop = load(tmp_path, category, "012")
    (lid,) = laptop.joints
    np.testing.assert_allclose(lid.axis, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose((lid.lower, lid.upper, lid.rest), np.deg2rad([0, 130, 90]), atol=1e-12)
    np.testing.assert_allclose(laptop.meshes[0].bounds, LAPTOP_BASE.bounds, atol=1e-9)


def test_instances_are_sorted_without_hidden_and_excluded_ones(tmp_path):
    for name in ("003", "001", "034", ".git"):
        hoi4d_safe(tmp_path / "Safe" / name)
    source = open_source("hoi4d", load_category("safe"), tmp_path, 0)
    assert source.instance_ids() == ["001", "003"]
    assert source.left_out() == {"034": "the category 'safe' excludes the model by its name"}
    with pytest.raises(ValueError, match=r"Safe/034: no instance is left, category 'safe' excludes 034; name another"):
        open_source("hoi4d", load_category("safe"), tmp_path / "Safe/034", 0)
    assert open_source("hoi4d", load_category("articulated"), tmp_path / "Safe/034", 0).instance_ids() == ["034"]
    with pytest.raises(ValueError, match="no objects of category 'oven'"):
        open_source("hoi4d", load_category("oven"), tmp_path, 0)


def change(file, edit):
    content = json.loads(file.read_text(encoding="utf-8"))
    edit(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda nodes: nodes[2].update(joint="扭曲"), r"node 2 is malformed .*unknown joint type '扭曲'"),
        (lambda nodes: nodes[2].update(jointData={}), r"node 2 is malformed \(KeyError: 'axis'\)"),
        (lambda nodes: nodes[2].update(parent=9), "refers to unknown link 'link_9'"),
        (lambda nodes: nodes[2].update(parent=3), "form a cycle"),
        (lambda nodes: nodes[3].update(id=2), "occurs more than once"),
        (lambda nodes: nodes[2]["parts"][0].update(id=99), r"node 2 has part 99, which .*result\.json lacks"),
        (lambda nodes: nodes[2]["jointData"]["axis"].update(direction=[0, 0, 0]), "zero axis"),
        (lambda nodes: nodes[2]["jointData"]["axis"].update(direction=[0, 1]), "node 2 is malformed"),
        (lambda nodes: nodes[2]["jointData"]["limit"].update(a=None), "node 2 is malformed"),
        (lambda nodes: nodes[2].update(parts=[]), "part 'door' is empty|moves links without any mesh"),
        (lambda nodes: nodes.clear(), "no matching parts"),
    ],
)
def test_malformed_mobility_is_one_error_that_names_the_file(tmp_path, edit, message):
    folder = hoi4d_safe(tmp_path / "003")
    change(folder / "mobility_v2.json", edit)
    if "lacks" not in message and "empty" in message:
        change(folder / "mobility_v2.json", lambda nodes: nodes[3].update(parts=[]))
    with pytest.raises(ValueError, match=message) as error:
        load(tmp_path, "safe", "003")
    assert "mobility_v2.json" in str(error.value)


def test_unusable_meshes_are_named(tmp_path):
    folder = hoi4d_safe(tmp_path / "003")
    change(folder / "result.json", lambda tree: tree[0]["children"][0]["children"][0].update(objs=["../../new-0"]))
    with pytest.raises(ValueError, match=r"result\.json: 'objs/\.\./\.\./new-0\.obj' points to .*outside"):
        load(tmp_path, "safe", "003")
    (folder / "result.json").write_text('["no tree"]')
    with pytest.raises(ValueError, match=r"result\.json: is not a tree of parts"):
        load(tmp_path, "safe", "003")
    folder = hoi4d_safe(tmp_path / "004")
    (folder / "objs/new-1.obj").unlink()
    with pytest.raises(ValueError, match=r"new-1\.obj: mesh is missing"):
        load(tmp_path, "safe", "004")
