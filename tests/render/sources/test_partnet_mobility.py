import json

import numpy as np
import pytest
from dataset_writers import CABINET, DOOR, HINGE, KNOB, LAPTOP_BASE, LID, LID_HINGE, box, partnet_safe, write_partnet

from datamodules.manifest import Manifest
from render import generate, preview
from render.category import load_category
from render.sources import open_source
from render.sources.partnet_mobility import read_semantics

BASE_JOINT = 'rpy="1.570796326794897 0 -1.570796326794897" xyz="0 0 0"'


def load(root, category, instance_id):
    return open_source("partnet-mobility", load_category(category), root, 0).load(instance_id)


def on_line(point, pivot, axis) -> bool:
    return np.linalg.norm(np.cross(np.subtract(point, pivot), axis)) < 1e-9


def union(*meshes):
    return np.min([m.bounds[0] for m in meshes], axis=0), np.max([m.bounds[1] for m in meshes], axis=0)


def test_safe_keeps_the_object_frame_and_merges_the_knob_into_the_door(tmp_path):
    partnet_safe(tmp_path / "101")
    safe = load(tmp_path, "safe", "101")
    assert safe.part_names == ("body", "door")
    np.testing.assert_allclose(safe.meshes[0].bounds, CABINET.bounds, atol=1e-9)
    np.testing.assert_allclose(safe.meshes[1].bounds, union(DOOR, KNOB), atol=1e-9)
    (door,) = safe.joints
    assert (door.parent, door.child, door.rest, door.lower) == (0, 1, 0, 0)
    assert door.upper == pytest.approx(1.8)
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    assert on_line(HINGE, door.pivot, door.axis)


def test_open_door_is_where_the_urdf_puts_it(tmp_path):
    partnet_safe(tmp_path / "101")
    safe = load(tmp_path, "safe", "101").at_rest([np.pi / 2])
    # A quarter turn about -y through (-0.5, ., 0.4) takes (x, z) to (-0.5 - (z - 0.4), 0.4 + (x + 0.5)).
    np.testing.assert_allclose(safe.meshes[1].bounds, [[-0.6, 0, 0.4], [-0.5, 1, 1.4]], atol=1e-9)


@pytest.mark.parametrize(
    ("axis", "limits"), [((0, 0.1, 0), (-1.8, 0.0)), ((0, 1, 0), (-1.8, 0.0)), ((0, -1, 0), (0.0, 1.8))]
)
def test_coordinate_opens_whatever_the_sign_of_axis_and_limits(tmp_path, axis, limits):
    partnet_safe(tmp_path / "101", axis=axis, limits=limits)
    (door,) = load(tmp_path, "safe", "101").joints
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose((door.lower, door.upper, door.rest), (0, 1.8, 0), atol=1e-12)


def test_door_without_limits_opens_outwards(tmp_path):
    partnet_safe(tmp_path / "101", type="continuous", axis=(0, 1, 0), limits=(0.0, 0.0))
    (door,) = load(tmp_path, "safe", "101").joints
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    assert (door.lower, door.upper, door.rest) == (-np.pi, np.pi, 0)


def test_base_joint_edited_by_hand_changes_nothing(tmp_path):
    folder = partnet_safe(tmp_path / "101")
    before = load(tmp_path, "safe", "101")
    urdf = (folder / "mobility.urdf").read_text()
    assert BASE_JOINT in urdf
    (folder / "mobility.urdf").write_text(urdf.replace(BASE_JOINT, 'rpy="0 0 0.7" xyz="0 0 0"'))
    after = load(tmp_path, "safe", "101")
    np.testing.assert_allclose(after.meshes[1].vertices, before.meshes[1].vertices, atol=1e-12)
    np.testing.assert_allclose(after.joints[0].axis, before.joints[0].axis, atol=1e-12)


def laptop_links(limits, axis):
    screen = {"mesh": LID, "semantic": "hinge", "label": "screen", "parent": 1, "origin": LID_HINGE, "type": "revolute"}
    base = {"mesh": LAPTOP_BASE, "semantic": "free", "label": "laptop_base"}
    return [{**screen, "limits": limits, "axis": axis}, base]


def test_laptop_with_zero_outside_its_limits(tmp_path):
    # Stored upright at 0, closed at -pi/2 about -x; the limits stop short of the stored state.
    write_partnet(tmp_path / "7", "Laptop", laptop_links((-np.pi / 2, -0.2), (-1, 0, 0)))
    laptop = load(tmp_path, "laptop", "7")
    (lid,) = laptop.joints
    np.testing.assert_allclose(lid.axis, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose((lid.lower, lid.upper), (0, np.pi / 2 - 0.2), atol=1e-12)
    assert lid.rest == pytest.approx(np.pi / 2)
    assert on_line(LID_HINGE, lid.pivot, lid.axis)
    closed = laptop.at_rest([0.0])
    np.testing.assert_allclose(closed.meshes[1].bounds, [[-0.5, 0.0, -0.35], [0.5, 0.05, 0.32]], atol=1e-9)


def drawer_links(count, axis, limits):
    links = [{"mesh": CABINET, "semantic": "heavy", "label": "furniture_body"}]
    for k in range(count):
        links.append(
            {
                "mesh": box([-0.4, 0.1 + 0.25 * k, -0.3], [0.4, 0.3 + 0.25 * k, 0.45]), "semantic": "slider",
                "label": "drawer", "parent": 0, "type": "prismatic", "axis": axis, "limits": limits,
                "origin": (0.3 * k, 0, 0),
            }
        )  # fmt: skip
    links.append({"mesh": DOOR, "semantic": "hinge", "label": "rotation_door", "parent": 0, "type": "revolute",
                  "axis": (0, 1, 0), "limits": (0.0, 1.0), "origin": HINGE})  # fmt: skip
    return links


@pytest.mark.parametrize(("axis", "limits"), [((0, 0, 0.1), (0.0, 0.5)), ((0, 0, -1), (-0.5, 0.0))])
def test_drawers_are_numbered_from_the_top_and_slide_to_the_front(tmp_path, axis, limits):
    write_partnet(tmp_path / "9", "StorageFurniture", drawer_links(3, axis, limits))
    chest = load(tmp_path, "drawer", "9")
    heights = [mesh.bounds[0, 1] for mesh in chest.meshes[1:]]
    np.testing.assert_allclose(heights, [0.6, 0.35, 0.1], atol=1e-9)
    for joint in chest.joints:
        np.testing.assert_allclose(joint.axis, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose((joint.lower, joint.upper, joint.rest), (0, 0.5, 0), atol=1e-12)
    np.testing.assert_allclose(chest.meshes[0].bounds, union(CABINET, DOOR), atol=1e-9)


def test_sliding_and_rotating_part_is_found_through_its_unlabelled_link(tmp_path):
    folder = write_partnet(tmp_path / "9", "StorageFurniture", drawer_links(3, (0, 0, 1), (0.0, 0.5)))
    text = (folder / "mobility.urdf").read_text()
    # "slider+": the drawer slides with a link of its own and turns on that.
    text = text.replace('<child link="link_1"/>', '<child link="link_1_helper"/>')
    text = text.replace(
        "</robot>",
        '<link name="link_1_helper"/><joint name="turn" type="continuous"><parent link="link_1_helper"/>'
        '<child link="link_1"/><axis xyz="0 0 1"/></joint></robot>',
    )
    (folder / "mobility.urdf").write_text(text)
    chest = load(tmp_path, "drawer", "9")
    assert [joint.name for joint in chest.joints] == ["joint_3", "joint_2", "joint_1"]


def test_only_objects_with_exactly_the_categorys_parts_are_instances(tmp_path):
    partnet_safe(tmp_path / "30")
    partnet_safe(tmp_path / "4")
    partnet_safe(tmp_path / ".hidden")
    two_doors = partnet_safe(tmp_path / "50")
    semantics = (two_doors / "semantics.txt").read_text()
    (two_doors / "semantics.txt").write_text(semantics.replace("hinge knob", "hinge door"))
    write_partnet(tmp_path / "60", "Laptop", laptop_links((-1.0, 1.0), (1, 0, 0)))
    source = open_source("partnet-mobility", load_category("safe"), tmp_path, 0)
    assert source.instance_ids() == ["30", "4"]
    assert source.left_out() == {"50": "2 movable part(s) labelled '^door$' instead of 1"}
    assert open_source("partnet-mobility", load_category("articulated"), tmp_path, 0).instance_ids() == [
        "30", "4", "50", "60",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"no matching parts, none of 4 objects is of model_cat Oven .*\^door\$"):
        open_source("partnet-mobility", load_category("oven"), tmp_path, 0).instance_ids()


def test_generator_and_preview_say_once_what_is_left_out_and_why(tmp_path, capsys):
    for name in ("30", "40", "50", "60"):
        partnet_safe(tmp_path / "objects" / name)
    for name in ("40", "50"):
        file = tmp_path / "objects" / name / "semantics.txt"
        file.write_text(file.read_text().replace("hinge knob", "hinge door"))
    options = ["--category", "safe", "--source", "partnet-mobility", "--root", str(tmp_path / "objects")]
    size = ["--states", "1", "--rotations", "1", "--points", "32", "--workers", "1"]
    size += ["--train-instances", "1", "--test-instances", "0"]
    assert generate.main([*options, "--out", str(tmp_path / "out"), *size]) == 0
    two_doors = "2 movable part(s) labelled '^door$' instead of 1"
    too_many = "more than --train-instances 1 and --test-instances 0 take"
    lines = [f"left out 2 object(s), {two_doors}: 40, 50\n", f"left out 1 object(s), {too_many}: 60\n"]
    said = capsys.readouterr().err
    assert [said.count(line) for line in lines] == [1, 1]
    manifest = Manifest.load(tmp_path / "out" / "safe" / "partnet-mobility-complete")
    assert manifest.left_out == {"40": two_doors, "50": two_doors, "60": too_many}
    assert preview.main([*options, "--out", str(tmp_path / "preview")]) == 0
    assert capsys.readouterr().err.count(lines[0]) == 1


def test_one_object_folder_is_a_root_too_and_meta_may_be_missing(tmp_path):
    (partnet_safe(tmp_path / "101") / "meta.json").unlink()
    source = open_source("partnet-mobility", load_category("safe"), tmp_path / "101", 0)
    assert source.instance_ids() == ["101"]
    assert source.load("101").name == "101"


def test_articulated_takes_all_joints_as_they_are(tmp_path):
    partnet_safe(tmp_path / "101", axis=(0, 0.1, 0), limits=(-1.8, -0.3))
    safe = load(tmp_path, "articulated", "101")
    assert safe.part_names == ("base", "link_1", "link_2")
    assert [(j.parent, j.child) for j in safe.joints] == [(0, 1), (1, 2)]
    np.testing.assert_allclose(safe.joints[0].axis, [0, 1, 0], atol=1e-12)
    assert (safe.joints[0].lower, safe.joints[0].upper, safe.joints[0].rest) == (-1.8, -0.3, 0)
    assert (safe.joints[1].lower, safe.joints[1].upper) == (-np.pi, np.pi)


@pytest.mark.parametrize("content", ["[1]", "null"])
def test_a_meta_file_that_is_no_object_is_a_broken_instance(tmp_path, content):
    partnet_safe(tmp_path / "101")
    (tmp_path / "101" / "meta.json").write_text(content)
    with pytest.raises(ValueError, match=r"101/meta\.json: is not a JSON object"):
        load(tmp_path, "safe", "101")


def test_errors_name_the_file(tmp_path):
    folder = partnet_safe(tmp_path / "101")
    (folder / "semantics.txt").write_text("link_0 heavy\n")
    with pytest.raises(ValueError, match=r"semantics\.txt: line 'link_0 heavy' is not"):
        read_semantics(folder / "semantics.txt")
    (folder / "semantics.txt").unlink()
    with pytest.raises(ValueError, match=r"101/semantics\.txt: missing"):
        load(tmp_path, "safe", "101")
    (folder / "meta.json").write_text(json.dumps({"model_cat": "Safe"})[:-3])
    with pytest.raises(ValueError, match=r"101/meta\.json: not valid JSON"):
        load(tmp_path, "safe", "101")
    with pytest.raises(ValueError, match="no instance found"):
        open_source("partnet-mobility", load_category("safe"), folder / "textured_objs", 0)
    with pytest.raises(ValueError, match="not a folder"):
        open_source("partnet-mobility", load_category("safe"), tmp_path / "nowhere", 0)
