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
    box,
    motion_node,
    write_mdv02,
    write_obj,
    write_shape2motion,
)

from render.category import load_category
from render.sources import open_source
from render.sources.shape2motion import read_shape

FRAME = box([-0.5, -0.15, 0], [0.5, 0.15, 0.05])
LEFT_LEG, RIGHT_LEG = box([-0.5, 0, -1], [-0.46, 0.05, 0]), box([0.46, 0, -1], [0.5, 0.05, 0])
LEFT_HINGE, RIGHT_HINGE = np.array([-0.48, 0.02, 0]), np.array([0.48, 0.02, 0])


def load(root, category, instance_id):
    return open_source("shape2motion", load_category(category), root, 0).load(instance_id)


def oven(direction=(0, -2.5, 0), extra=()):
    """A root, a door with a knob nested in it, and further nodes; leaves without children have null there."""
    knob = motion_node("dof_rootd_Aa001_r_Ba001_r", "rotation", (0.35, 0.5, 0.45), (0, 0, 1), None)
    door = motion_node("dof_rootd_Aa001_r", "rotation", HINGE, direction, [knob])
    return motion_node("dof_rootd", "none", children=[door, *extra])


OVEN_MESHES = {"dof_rootd": CABINET, "dof_rootd_Aa001_r": DOOR, "dof_rootd_Aa001_r_Ba001_r": KNOB}


def write_oven(layout, folder, tree, numpy_integers=False):
    folder.mkdir(parents=True)
    if layout == "original":
        return write_shape2motion(folder, tree, OVEN_MESHES)
    return write_mdv02(folder, tree, list(OVEN_MESHES.values()), numpy_integers)


@pytest.mark.parametrize("layout", ["original", "re-packed"])
@pytest.mark.parametrize("direction", [(0, -2.5, 0), (0, 1, 0)])
def test_door_opens_outwards_from_the_stored_state(tmp_path, layout, direction):
    write_oven(layout, tmp_path / "oven/0002", oven(direction))
    instance = load(tmp_path, "oven", "0002")
    assert instance.part_names == ("body", "door")
    np.testing.assert_allclose(instance.meshes[0].bounds, CABINET.bounds, atol=1e-9)
    np.testing.assert_allclose(instance.meshes[1].bounds, [DOOR.bounds[0], [0.5, 1, 0.5]], atol=1e-9)
    (door,) = instance.joints
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(door.pivot, HINGE, atol=1e-12)
    assert (door.lower, door.upper, door.rest) == (-np.pi, np.pi, 0)
    np.testing.assert_allclose(load_category("oven").sampled_ranges(instance), [(np.pi / 4, 3 * np.pi / 4)])


def test_both_layouts_give_the_same_object(tmp_path):
    write_oven("original", tmp_path / "oven/0001", oven())
    write_oven("re-packed", tmp_path / "oven/0002", oven(), numpy_integers=True)
    first, second = load(tmp_path, "oven", "0001"), load(tmp_path, "oven", "0002")
    for one, other in zip(first.meshes, second.meshes, strict=True):
        np.testing.assert_allclose(one.triangles, other.triangles, atol=1e-12)


@pytest.mark.parametrize("direction", [(1, 0, 0), (-3, 0, 0)])
def test_laptop_is_stored_at_a_right_angle(tmp_path, direction):
    lid = motion_node("dof_rootd_Aa001_r", "rotation", LID_HINGE, direction)
    tree = motion_node("dof_rootd", "none", children=[lid])
    (tmp_path / "0004").mkdir()
    write_mdv02(tmp_path / "0004", tree, [LAPTOP_BASE, LID])
    laptop = load(tmp_path, "laptop", "0004")
    (hinge,) = laptop.joints
    np.testing.assert_allclose(hinge.axis, [-1, 0, 0], atol=1e-12)
    assert hinge.rest == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(laptop.at_rest([0]).meshes[1].bounds, [[-0.5, 0, -0.35], [0.5, 0.05, 0.32]], atol=1e-9)


@pytest.mark.parametrize("layout", ["original", "re-packed"])
@pytest.mark.parametrize("signs", [(1, 1), (-1, 1)])
def test_eyeglasses_fold_inwards_and_the_face_map_is_exchanged(tmp_path, layout, signs):
    legs = [
        motion_node("dof_rootd_Aa001_r", "rotation", RIGHT_HINGE, (0, signs[0], 0)),
        motion_node("dof_rootd_Aa002_r", "rotation", LEFT_HINGE, (0, signs[1], 0)),
    ]
    tree = motion_node("dof_rootd", "none", children=legs)
    folder = tmp_path / "eyeglasses/0007"
    folder.mkdir(parents=True)
    if layout == "original":
        meshes = {"dof_rootd": FRAME, "dof_rootd_Aa001_r": RIGHT_LEG, "dof_rootd_Aa002_r": LEFT_LEG}
        write_shape2motion(folder, tree, meshes)
    else:
        write_mdv02(folder, tree, [FRAME, LEFT_LEG, RIGHT_LEG])  # part 1 is node 2
    glasses = load(tmp_path, "eyeglasses", "0007")
    np.testing.assert_allclose(glasses.meshes[1].bounds, LEFT_LEG.bounds, atol=1e-9)
    np.testing.assert_allclose(glasses.meshes[2].bounds, RIGHT_LEG.bounds, atol=1e-9)
    left, right = glasses.joints
    np.testing.assert_allclose([left.axis, right.axis], [[0, -1, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose([left.pivot, right.pivot], [LEFT_HINGE, RIGHT_HINGE], atol=1e-12)
    folded = glasses.at_rest([np.pi / 2, np.pi / 2])
    assert folded.meshes[1].bounds[0, 2] > -0.1
    assert folded.meshes[2].bounds[0, 2] > -0.1
    assert folded.meshes[1].bounds[1, 0] > 0.4  # the left tip lies at the right end of the frame


def test_first_rotation_is_the_categorys_and_spirals_stay(tmp_path):
    knob = motion_node("dof_rootd_Aa002_r", "rotation", (0, 0.9, 0.45), (0, 0, 1))
    screw = motion_node("dof_rootd_Aa003_rt", "spiral", (0, 0.9, 0.45), (0, 0, 1))
    tray = motion_node("dof_rootd_Aa004_t", "translation", (0, 0, 0), (0, 0, 1))
    folder = tmp_path / "0001"
    names = ("dof_rootd_Aa002_r", "dof_rootd_Aa003_rt", "dof_rootd_Aa004_t")
    write_shape2motion(folder, oven(extra=(knob, screw, tray)), {**OVEN_MESHES, **dict.fromkeys(names, KNOB)})
    instance = load(tmp_path, "oven", "0001")
    assert [joint.name for joint in instance.joints] == ["dof_rootd_Aa001_r"]
    assert len(instance.meshes[0].faces) == 12 * 4
    types = [joint.type for joint in read_shape(folder).joints]
    assert types == [0, 0, 0, None, 1]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda tree: tree["children"][0].update(motion_type="twist"), "unknown motion type 'twist'"),
        (lambda tree: tree["children"][0].update(direction=[0, 0, 0]), "zero axis"),
        (lambda tree: tree["children"][0].update(direction=[0, float("nan"), 0]), "NaN or infinite axis"),
        (lambda tree: tree["children"][0].pop("center"), r"is not a tree of motion nodes \(KeyError: 'center'\)"),
        (lambda tree: tree["children"][0]["children"][0].update(dof_name="dof_rootd_Aa001_r"), "occurs more than once"),
        (lambda tree: tree["children"][0].update(motion_type="translation", children=None), "no matching parts"),
        (lambda tree: tree["children"][0].update(dof_name="../../x"), "outside"),
    ],
)
def test_malformed_motion_is_one_error_that_names_the_file(tmp_path, edit, message):
    folder = write_oven("original", tmp_path / "0001", oven())
    tree = oven()
    edit(tree)
    (folder / "motion_attributes.json").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=message) as error:
        load(tmp_path, "oven", "0001")
    assert "0001/motion_attributes.json" in str(error.value)


def test_missing_files_and_maps_that_do_not_fit_are_named(tmp_path):
    folder = write_oven("original", tmp_path / "0001", oven())
    (folder / "part_objs/none_motion.obj").unlink()
    with pytest.raises(ValueError, match=r"none_motion\.obj: mesh is missing"):
        load(tmp_path, "oven", "0001")
    folder = write_oven("re-packed", tmp_path / "0002", oven())
    write_obj(folder / "summary.obj", CABINET)
    with pytest.raises(
        ValueError, match=r"dof_name_idx\.npy: does not map the 12 triangles of summary\.obj, it has 36"
    ):
        load(tmp_path, "oven", "0002")
    write_mdv02(folder, oven(), [CABINET, DOOR, KNOB, KNOB])
    with pytest.raises(ValueError, match=r"dof_name_idx\.npy: has parts 0 to 3, but motion_attributes\.json 3 nodes"):
        load(tmp_path, "oven", "0002")
