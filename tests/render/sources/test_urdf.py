"""The urdf source on real objects, on random kinematic trees against yourdfpy's kinematics, and on bad input."""

from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from dataset_writers import box, urdf_joint, urdf_link, write_obj, write_urdf
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.category import load_category
from render.sources import open_source
from render.sources.urdf import Z_UP_TO_Y_UP, read_urdf

TESTS = Path(__file__).parents[2]
FOLDERS = [
    folder for folder in (TESTS / "data/real_objects", TESTS.parents[1] / "shared/real_objects") if folder.is_dir()
]
REAL_OBJECTS = sorted({path for folder in FOLDERS for path in folder.rglob("*.urdf")})
MALFORMED = [path for path in REAL_OBJECTS if path.stem == "fridge_static"]
SOUND = [path for path in REAL_OBJECTS if path not in MALFORMED]
DATA = TESTS / "data/real_objects"


def load(root, category, instance_id=None):
    source = open_source("urdf", load_category(category), root, 0)
    return source.load(instance_id or source.instance_ids()[0])


@pytest.mark.parametrize("file", SOUND, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_real_object_loads_as_it_is(file):
    instance = load(file, "articulated")
    robot = yourdfpy.URDF.load(str(file), load_meshes=True, force_mesh=True)
    assert [joint.name for joint in instance.joints] == robot.actuated_joint_names
    for joint, reference in zip(instance.joints, robot.actuated_joints, strict=True):
        assert (joint.lower, joint.upper, joint.rest) == (reference.limit.lower, reference.limit.upper, 0)
    for fraction in (0.0, 0.3, 1.0):
        states = [joint.lower + fraction * (joint.upper - joint.lower) for joint in instance.joints]
        robot.update_cfg(states)
        corners = robot.scene.bounds @ Z_UP_TO_Y_UP.T
        posed = instance.at_rest(states)
        bounds = np.array([mesh.bounds for mesh in posed.meshes])
        np.testing.assert_allclose([bounds[:, 0].min(0), bounds[:, 1].max(0)], np.sort(corners, axis=0), atol=1e-5)


@pytest.mark.parametrize("file", MALFORMED, ids=lambda path: path.stem)
def test_malformed_real_object_is_refused(file):
    with pytest.raises(ValueError, match=r"fridge_static\.urdf: <mesh scale='1\.0, 1\.0, 1\.0'> is malformed"):
        load(file, "articulated")


def test_laptop_closed_at_its_upper_limit():
    laptop = load(DATA / "laptop", "laptop")
    (lid,) = laptop.joints
    assert (lid.lower, lid.upper, lid.rest) == (0, 1.57, 1.57)  # stored open; the URDF's q is 1.57 - ours
    np.testing.assert_allclose(lid.axis, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(lid.pivot, [0, 0.031, -0.151], atol=1e-12)  # (0, 0.151, 0.031) with z up
    heights = [laptop.at_rest([q]).meshes[1].bounds[1, 1] for q in (0.0, 0.5, 1.0, 1.57)]
    assert heights[0] < 0.07
    assert sorted(heights) == heights
    np.testing.assert_allclose(load_category("laptop").sampled_ranges(laptop), [(np.deg2rad(9), 1.57)])


def test_a_serial_chain_comes_back_from_a_urdf(tmp_path):
    """A procedural lamp, written with every link in its joint's frame and read as one of its category."""
    lamp = open_source("procedural", load_category("desk_lamp"), None, 3).load("desk_lamp-0001")
    pivots = np.concatenate([np.zeros((1, 3)), [joint.pivot for joint in lamp.joints]])
    links = ["stand", "lower rod", "upper rod", "head of the lamp"]
    body = []
    for name, mesh, pivot in zip(links, lamp.meshes, pivots, strict=True):
        write_obj(tmp_path / f"{name}.obj", box(*(mesh.bounds - pivot)), Z_UP_TO_Y_UP.T)
        body.append(f'<link name="{name}"><visual><geometry><mesh filename="{name}.obj"/></geometry></visual></link>')
    for joint in lamp.joints:
        xyz = Z_UP_TO_Y_UP.T @ (pivots[joint.child] - pivots[joint.parent])
        extra = f'<origin xyz="{" ".join(map(repr, xyz.tolist()))}"/>'
        limit = f'<limit lower="0" upper="{joint.upper!r}"/>'
        parts = {"axis": '<axis xyz="1 0 0"/>', "limit": limit, "extra": extra}
        body.append(urdf_joint(joint.name, links[joint.parent], links[joint.child], **parts))
    write_urdf(tmp_path / "lamp.urdf", "\n".join(body))
    found = load(tmp_path, "desk_lamp")
    assert [(j.parent, j.child) for j in found.joints] == [(0, 1), (1, 2), (2, 3)]
    for states in ([0.0, 0.0, 0.0], [0.3, 1.2, 0.5]):
        np.testing.assert_allclose(found.part_motion(states), lamp.part_motion(np.array(states)), atol=1e-9)


@pytest.mark.parametrize("category", ["safe", "oven", "washing_machine"])
def test_microwave_opens_to_the_front(category):
    microwave = load(DATA / "microwave", category)
    (door,) = microwave.joints
    np.testing.assert_allclose((door.lower, door.upper, door.rest), (0, 2.094, 0))
    np.testing.assert_allclose(door.axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(door.pivot, [-0.1725, 0.096, 0.088], atol=1e-12)
    assert microwave.at_rest([1.5]).meshes[1].bounds[1, 2] > microwave.meshes[0].bounds[1, 2] + 0.1


def test_ids_are_paths_and_a_category_must_match():
    source = open_source("urdf", load_category("articulated"), DATA, 0)
    assert source.instance_ids() == [
        "drawer/metaworld_drawer/object", "laptop/metaworld_laptop/object", "microwave/libero_microwave/object",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"no matching parts for category 'drawer': it needs 3 prismatic joint\(s\)"):
        load(DATA, "drawer", "drawer/metaworld_drawer/object")
    with pytest.raises(ValueError, match="needs a root"):
        open_source("urdf", load_category("laptop"), None, 0)


TYPES = ("fixed", "revolute", "prismatic", "continuous")
number = st.floats(-1, 1).map(lambda x: round(x, 3))
vector = st.tuples(number, number, number)


@st.composite
def trees(draw):
    """A random URDF: per link but the first its parent, joint type, origin and axis; links 1.. in shuffled order."""
    count = draw(st.integers(2, 6))
    joints = []
    for child in range(1, count):
        axis = draw(vector.filter(lambda a: np.linalg.norm(a) > 0.1))
        kind = draw(st.sampled_from(TYPES)) if child > 1 else "revolute"
        joints.append((draw(st.integers(0, child - 1)), child, kind, draw(vector), draw(vector), axis))
    return draw(st.permutations(joints)), draw(st.lists(number, min_size=count, max_size=count))


def tree_urdf(joints) -> str:
    def text(values):
        return " ".join(map(str, values))

    parts = [urdf_link(f"l{k}", f"{0.1 * (k + 1):.1f} 0.2 0.3") for k in range(len(joints) + 1)]
    for parent, child, kind, xyz, rpy, axis in joints:
        origin = f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/>'
        limit = '<limit lower="-1" upper="1"/>'
        parts.append(urdf_joint(f"j{child}", f"l{parent}", f"l{child}", kind, axis=f'<axis xyz="{text(axis)}"/>',
                                limit=limit, extra=origin))  # fmt: skip
    return "\n".join(parts)


@settings(max_examples=40, deadline=None)
@given(tree=trees())
def test_posed_random_trees_agree_with_yourdfpy(tmp_path_factory, tree):
    joints, states = tree
    file = write_urdf(tmp_path_factory.mktemp("tree") / "tree.urdf", tree_urdf(joints))
    instance = load(file, "articulated")
    moving = [child for _, child, kind, *_ in joints if kind != "fixed"]
    assert instance.part_names == ("l0", *(f"l{child}" for child in moving))
    posed = instance.at_rest(states[: len(moving)])

    robot = yourdfpy.URDF.load(str(file))
    for joint in robot.robot.joints:
        joint.axis = joint.axis / np.linalg.norm(joint.axis)  # yourdfpy takes the axis as it is
    robot.update_cfg(states[: len(moving)])
    above = {child: parent for parent, child, *_ in joints}
    for part, name in enumerate(instance.part_names):
        # All links that reach this part's own link through fixed joints only.
        links = [k for k in range(len(joints) + 1) if f"l{owner(k, above, moving)}" == name]
        reference = [robot.get_transform(f"l{k}") for k in sorted(links)]
        corners = [box([-0.05 * (k + 1), -0.1, -0.15], [0.05 * (k + 1), 0.1, 0.15]).vertices for k in sorted(links)]
        expected = np.concatenate(
            [c @ pose[:3, :3].T + pose[:3, 3] for c, pose in zip(corners, reference, strict=True)]
        )
        found = posed.meshes[part].vertices @ Z_UP_TO_Y_UP
        assert len(found) == len(expected)
        assert cKDTree(found).query(expected)[0].max() < 1e-9
        assert cKDTree(expected).query(found)[0].max() < 1e-9


def owner(link, above, moving):
    return link if link == 0 or link in moving else owner(above[link], above, moving)


@settings(max_examples=40, deadline=None)
@given(tree=trees(), data=st.data())
def test_corrupted_random_trees_are_one_error_that_names_the_file(tmp_path_factory, tree, data):
    joints, _ = tree
    victim = data.draw(st.integers(1, len(joints)))
    corruption = data.draw(st.sampled_from(["cycle", "unknown", "two parents", "no parent", "mimic", "nan", "type"]))
    text = tree_urdf(joints)
    joint = next(line for line in text.splitlines() if f'<joint name="j{victim}"' in line)
    parent = next(parent for parent, child, *_ in joints if child == victim)
    changed = {
        "cycle": joint.replace(f'<parent link="l{parent}"/>', f'<parent link="l{victim}"/>'),
        "unknown": joint.replace(f'<parent link="l{parent}"/>', '<parent link="nowhere"/>'),
        "two parents": joint + joint.replace(f'name="j{victim}"', 'name="again"'),
        "no parent": "",
        "mimic": joint.replace("</joint>", '<mimic joint="j1"/></joint>'),
        "nan": joint.replace('lower="-1"', 'lower="nan"'),
        "type": joint.replace('type="', 'type="un'),
    }[corruption]
    message = {
        "cycle": "cycle", "unknown": "unknown link 'nowhere'", "two parents": "child of two joints",
        "no parent": "no single root", "mimic": "mimic joints are not supported", "nan": "is NaN",
        "type": "has type 'un",
    }[corruption]  # fmt: skip
    file = write_urdf(tmp_path_factory.mktemp("tree") / "tree.urdf", text.replace(joint, changed))
    with pytest.raises(ValueError, match=message) as error:
        load(file, "articulated")
    assert str(file) in str(error.value)


TWO_LINKS = urdf_link("a") + urdf_link("b")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (urdf_link("a") + urdf_link("b") + urdf_joint("j", "a", "b") + urdf_joint("k", "b", "a"), "form a cycle"),
        (TWO_LINKS + urdf_joint("j", "a", "c"), "joint 'j' refers to unknown link 'c'"),
        (TWO_LINKS + urdf_joint("j", "a", "b", axis='<axis xyz="0 0 0"/>'), "joint 'j' has a zero axis"),
        (TWO_LINKS + urdf_joint("j", "a", "b", axis='<axis xyz="0 1"/>'), "has 2 numbers, not 3"),
        (TWO_LINKS + urdf_joint("j", "a", "b", axis='<axis xyz="nan 0 1"/>'), "is NaN or infinite"),
        (TWO_LINKS + urdf_joint("j", "a", "b", limit='<limit lower="1" upper="-1"/>'), r"reversed limits \[1, -1\]"),
        (TWO_LINKS + urdf_joint("j", "a", "b", limit='<limit lower="nan" upper="1"/>'), "is NaN or infinite"),
        (TWO_LINKS + urdf_joint("j", "a", "b", limit='<limit lower="0" upper="0"/>'), "state a range to move over"),
        (TWO_LINKS + urdf_joint("j", "a", "b", "prismatic", limit=""), r"has limits \[-inf, inf\]; state a range"),
        (TWO_LINKS + urdf_joint("j", "a", "b", extra='<mimic joint="j"/>'), "mimic joints are not supported"),
        (TWO_LINKS + urdf_joint("j", "a", "b", "planar"), "joint 'j' has type 'planar'; only fixed, revolute"),
        (TWO_LINKS + urdf_joint("j", "a", "b", "fixed"), "no joint moves"),
        (TWO_LINKS, "no single root, links 'a', 'b' have no parent"),
        ("", "has no links"),
        (urdf_link("a") * 2, "link name 'a' occurs more than once"),
        (
            TWO_LINKS + urdf_joint("j", "a", "b") + '<joint name="x" type="fixed"><parent link="a"/></joint>',
            "no <child>",
        ),
        (TWO_LINKS + '<joint type="fixed"><parent link="a"/><child link="b"/></joint>', "<joint> '' has no attribute"),
        ("<link/>", "<link> '' has no attribute 'name'"),
        (urdf_link("a") + '<link name="b"/>' + urdf_joint("j", "a", "b"), "part 'b' is empty"),
        (urdf_link("a") + urdf_link("b", "0 0 0") + urdf_joint("j", "a", "b"), "<box size='0 0 0'> is not positive"),
        (urdf_link("a") + urdf_link("b", "1 -1 1") + urdf_joint("j", "a", "b"), "<box size='1 -1 1'> is not positive"),
        (TWO_LINKS.replace('<box size="1 1 1"', '<sphere radius="0"'), "<sphere radius='0'> is not positive"),
        (
            TWO_LINKS.replace('<box size="1 1 1"', '<cylinder radius="1" length="-1"'),
            "<cylinder length='-1'> is not positive",
        ),
        (urdf_link("a") + urdf_link("b", "1e60 1 1") + urdf_joint("j", "a", "b"), "part 'b' is 1e\\+60 large"),
        (urdf_link("a") + urdf_link("b", "1e-60 1e-60 1e-60") + urdf_joint("j", "a", "b"), "part 'b' is 1e-60 large"),
        ('<link name="a"><visual/></link>', "needs a <geometry>|must have one <geometry>"),
        (
            '<link name="a"><visual><geometry><mesh/></geometry></visual></link>',
            "<mesh> '' has no attribute 'filename'",
        ),
        ('<link name="a"><visual><geometry><cone/></geometry></visual></link>', r"\['cone'\]"),
        ('<link name="a">', "not well-formed XML"),
    ],
)
def test_bad_urdf_is_one_error_that_names_the_file(tmp_path, body, message):
    file = write_urdf(tmp_path / "bad.urdf", body)
    with pytest.raises(ValueError, match=message) as error:
        load(tmp_path, "articulated", "bad")
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ("gone.obj", r"gone\.obj: mesh is missing"),
        ("empty.obj", r"empty\.obj: mesh is empty"),
        ("nan.obj", r"nan\.obj: mesh has NaN"),
        ("../outside.obj", r"bad\.urdf: '\.\./outside\.obj' points to .*outside"),
        ("/etc/passwd", r"bad\.urdf: '/etc/passwd' points to /etc/passwd, outside"),
        ("package://robot/../../outside.obj", "outside"),
        ("package://robot/gone.obj", r"bad\.urdf: mesh 'package://robot/gone\.obj' is missing"),
        ("https://example.org/a.obj", "is not a file path"),
    ],
)
def test_unusable_mesh_is_one_error_that_names_the_file(tmp_path, mesh, message):
    root = tmp_path / "root"
    write_obj(tmp_path / "outside.obj", box([0, 0, 0], [1, 1, 1]))
    visual = f'<link name="b"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>'
    write_urdf(root / "bad.urdf", urdf_link("a") + visual + urdf_joint("j", "a", "b"))
    (root / "empty.obj").write_text("")
    (root / "nan.obj").write_text("v 0 0 nan\nv 0 1 0\nv 1 0 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=message):
        load(root, "articulated")


def test_entity_bomb_is_refused(tmp_path):
    entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
    bomb = f'<!DOCTYPE robot [<!ENTITY e0 "ha">{entities}]><robot name="&e11;"><link name="a"/></robot>'
    (tmp_path / "bomb.urdf").write_text(bomb)
    with pytest.raises(ValueError, match=r"bomb\.urdf: declares a DTD or entities"):
        load(tmp_path, "articulated")


def test_other_roots_and_files_are_refused(tmp_path):
    (tmp_path / "x.urdf").write_text("<sdf/>")
    with pytest.raises(ValueError, match="is not a URDF, its outermost element is <sdf>"):
        load(tmp_path, "articulated")
    (tmp_path / "empty").mkdir()
    for folder, message in (("empty", r"no \*\.urdf file in this folder"), ("nowhere", "no such folder")):
        with pytest.raises(ValueError, match=message):
            open_source("urdf", load_category("laptop"), tmp_path / folder, 0)


def test_what_is_not_read_may_hold_anything(tmp_path):
    limit = '<limit lower="0" upper="1" effort="abc" velocity=""/>'
    extra = '<safety_controller k_velocity="x"/><calibration rising="x"/><dynamics damping="x"/>'
    body = TWO_LINKS.replace("<visual>", '<visual><material name="m"><color rgba="red"/></material>')
    write_urdf(tmp_path / "a.urdf", body + urdf_joint("j", "a", "b", limit=limit, extra=extra))
    assert load(tmp_path, "articulated").joints[0].upper == 1
    write_urdf(tmp_path / "a.urdf", TWO_LINKS + urdf_joint("j", "a", "b", extra='<mimic joint="k" multiplier="x"/>'))
    with pytest.raises(ValueError, match=r"a\.urdf: joint 'j' mimics 'k'"):
        load(tmp_path, "articulated")


def test_what_the_parser_cannot_read_is_one_error_that_names_the_file(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise AttributeError("no such thing")

    monkeypatch.setattr(yourdfpy.URDF, "load", fail)
    write_urdf(tmp_path / "a.urdf", TWO_LINKS + urdf_joint("j", "a", "b"))
    with pytest.raises(ValueError, match=r"a\.urdf: not a readable URDF \(AttributeError: no such thing\)"):
        load(tmp_path, "articulated")


def test_files_are_found_through_links_and_with_suffixes_of_any_case(tmp_path):
    body = TWO_LINKS + urdf_joint("j", "a", "b")
    write_urdf(tmp_path / "elsewhere" / "x.urdf", body)
    for name in ("a.urdf", "a.URDF"):
        write_urdf(tmp_path / "root" / name, body)
    (tmp_path / "root" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "root" / "linked" / "back").symlink_to(tmp_path / "root")
    source = open_source("urdf", load_category("articulated"), tmp_path / "root", 0)
    assert source.instance_ids() == ["a", "a.URDF", "linked/x"]
    assert len(source.load("linked/x").joints) == 1


def test_mesh_scale_package_path_and_primitives(tmp_path):
    write_obj(tmp_path / "robot/meshes/cube.obj", box([0, 0, 0], [1, 1, 1]))
    mesh = '<mesh filename="package://robot/meshes/cube.obj" scale="{}"/>'
    shapes = [mesh.format("2"), mesh.format("1 -2 3"), '<cylinder radius="1" length="4"/>', '<sphere radius="2"/>']
    visual = '<visual><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><geometry>{}</geometry></visual>'
    links = "".join(f'<link name="l{k}">{visual.format(shape)}</link>' for k, shape in enumerate(shapes))
    joints = "".join(urdf_joint(f"j{k}", "l0", f"l{k}", "continuous", limit="") for k in (1, 2, 3))
    file = write_urdf(tmp_path / "robot/urdf/x.urdf", links + joints)
    bounds = [link.mesh.bounds for link in read_urdf(file, tmp_path).links]
    expected = [[[-2, 0, 1], [0, 2, 3]], [[0, 0, 1], [2, 1, 4]], [[-1, -1, -1], [1, 1, 3]], [[-2, -2, -1], [2, 2, 3]]]
    np.testing.assert_allclose(bounds, expected, atol=0.02)
    assert all(link.mesh.volume > 0 for link in read_urdf(file, tmp_path).links)


def test_labels_choose_among_joints_of_one_type(tmp_path):
    knob = urdf_link("knob", "0.1 0.1 0.1") + urdf_joint("k", "body", "knob", axis='<axis xyz="0 1 0"/>')
    door = urdf_link("front_door", "1 0.1 1") + urdf_joint("d", "body", "front_door", extra='<origin xyz="-.5 -.5 0"/>')
    tray = urdf_link("tray") + urdf_joint("t", "body", "tray", "prismatic")
    file = write_urdf(tmp_path / "x.urdf", urdf_link("body") + knob + door + tray)
    oven = load(file, "oven")
    assert [joint.name for joint in oven.joints] == ["d"]
    assert oven.joints[0].type == REVOLUTE
    assert len(oven.meshes[0].faces) == 36
    assert [joint.type for joint in load(file, "articulated").joints] == [REVOLUTE, REVOLUTE, PRISMATIC]
    write_urdf(tmp_path / "x.urdf", urdf_link("body") + knob + door.replace("front_door", "panel"))
    with pytest.raises(ValueError, match=r"needs 1 revolute joint\(s\) labelled 'door', the object has revolute 'k'"):
        load(file, "oven")
