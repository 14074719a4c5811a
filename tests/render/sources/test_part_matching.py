import numpy as np
import pytest
from dataset_writers import CABINET, DOOR, HINGE, KNOB, LAPTOP_BASE, LID, LID_HINGE, box

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.category import load_category
from render.sources.link_graph import Link, LinkGraph, LinkJoint
from render.sources.part_matching import joint_groups, require_rules, to_category

FRAME = box([-0.5, -0.15, 0], [0.5, 0.15, 0.05])
LEGS = box([-0.5, 0, -1], [-0.46, 0.05, 0]), box([0.46, 0, -1], [0.5, 0.05, 0])
DRAWERS = [box([-0.4, 0.1 + 0.3 * k, -0.3], [0.4, 0.3 + 0.3 * k, 0.42]) for k in range(3)]
OPEN_DOOR = box([-0.55, 0, 0.4], [-0.5, 1, 1.4])
BOTTOM_HINGE = np.array([0.2, 0, 0.4])


def graph_of(file, base, *moving) -> LinkGraph:
    """A base and what moves on it: mesh, joint type, axis, pivot, lower, upper, label."""
    links, joints = [Link("base", base)], []
    for k, (mesh, kind, axis, pivot, lower, upper, label) in enumerate(moving):
        links.append(Link(f"part{k}", mesh))
        axis, pivot = np.array(axis, dtype=float), np.array(pivot, dtype=float)
        joints.append(LinkJoint(f"joint{k}", kind, "base", f"part{k}", axis, pivot, lower, upper, label))
    return LinkGraph(file, tuple(links), tuple(joints))


# Category, canonical graph, expected axis, upper limit and rest coordinate of every joint.
INF = np.inf
CASES = {
    "side-hinged door": ("safe", CABINET, [(DOOR, REVOLUTE, (0, 1, 0), HINGE, -1.9, 0, "door")], [(0, -1, 0)], 1.9, 0),
    "door stored open": ("safe", CABINET, [(OPEN_DOOR, REVOLUTE, (0, 2, 0), HINGE, 0, 1.6, "")],
                         [(0, -1, 0)], 1.6, 1.6),
    "door without limits": ("safe", CABINET, [(DOOR, REVOLUTE, (0, 1, 0), HINGE, -INF, INF, "")],
                            [(0, -1, 0)], np.pi, 0),
    "door with limits all round": ("safe", CABINET, [(DOOR, REVOLUTE, (0, 1, 0), HINGE, -3.1415, 3.1415, "")],
                                   [(0, -1, 0)], np.pi, 0),
    "bottom-hinged door": ("oven", CABINET, [(DOOR, REVOLUTE, (1, 0, 0), BOTTOM_HINGE, 0, 1.5, "")],
                           [(1, 0, 0)], 1.5, 0),
    "lid": ("laptop", LAPTOP_BASE, [(LID, REVOLUTE, (1, 0, 0), LID_HINGE, -0.7, np.pi / 2, "")], [(-1, 0, 0)],
            np.pi / 2 + 0.7, np.pi / 2),
    "drawers": ("drawer", CABINET, [(DRAWERS[k], PRISMATIC, (0, 0, -1), (0, 0, 0), -0.6, 0, "") for k in (1, 2, 0)],
                [(0, 0, 1)] * 3, 0.6, 0),
    "legs": ("eyeglasses", FRAME, [(LEGS[1], REVOLUTE, (0, 1, 0), (0.48, 0, 0), 0, 1.4, ""),
                                   (LEGS[0], REVOLUTE, (0, 1, 0), (-0.48, 0, 0), -1.4, 0, "")],
             [(0, -1, 0), (0, 1, 0)], 1.4, 0),
}  # fmt: skip


@pytest.mark.parametrize("quarter_turns", range(4))
@pytest.mark.parametrize("case", CASES)
def test_every_category_opens_with_growing_coordinate_and_faces_the_front(tmp_path, case, quarter_turns):
    category, base, moving, axes, upper, rest = CASES[case]
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter_turns]
    turned = graph_of(tmp_path, base, *moving).rotated(np.array([[c, 0.0, s], [0, 1, 0], [-s, 0, c]]))
    instance = to_category(turned, load_category(category), "urdf", "x")
    assert instance.part_names == load_category(category).parts
    np.testing.assert_allclose(instance.meshes[0].bounds, base.bounds, atol=1e-9)
    np.testing.assert_allclose([joint.axis for joint in instance.joints], axes, atol=1e-9)
    for joint in instance.joints:
        assert (joint.upper, joint.rest) == pytest.approx((upper, rest))
        assert joint.lower == (0 if upper < np.pi else -np.pi)


def test_interchangeable_parts_are_numbered_by_place(tmp_path):
    category, base, moving, *_ = CASES["drawers"]
    chest = to_category(graph_of(tmp_path, base, *moving), load_category(category), "urdf", "x")
    np.testing.assert_allclose([mesh.bounds[0, 1] for mesh in chest.meshes[1:]], [0.7, 0.4, 0.1])
    category, base, moving, *_ = CASES["legs"]
    glasses = to_category(graph_of(tmp_path, base, *moving), load_category(category), "urdf", "x")
    assert glasses.meshes[1].bounds[1, 0] < 0 < glasses.meshes[2].bounds[0, 0]


def test_unmodelled_joints_keep_their_parts_where_they_are_stored(tmp_path):
    tray = box([-0.3, 0.5, -0.3], [0.3, 0.52, 0.3])
    graph = graph_of(
        tmp_path,
        CABINET,
        (DOOR, REVOLUTE, (0, 1, 0), HINGE, -1.9, 0, "door"),
        (KNOB, REVOLUTE, (0, 0, 1), (0, 0.9, 0.5), 1.0, 2.0, "knob"),
        (tray, PRISMATIC, (0, 0, 1), (0, 0, 0), -INF, INF, "tray"),
    )
    safe = to_category(graph, load_category("safe"), "urdf", "x")
    assert len(safe.joints) == 1
    stored = np.concatenate([CABINET.vertices, KNOB.vertices, tray.vertices])
    np.testing.assert_allclose(np.sort(safe.meshes[0].vertices, axis=0), np.sort(stored, axis=0))


def test_a_category_needs_rules_for_the_source():
    with pytest.raises(ValueError, match="source 'hoi4d' has no objects of category 'oven'; it can be read from urdf"):
        require_rules(load_category("oven"), "hoi4d")
    require_rules(load_category("articulated"), "hoi4d")
    groups = joint_groups(load_category("drawer"), "partnet-mobility")
    assert groups == {(PRISMATIC, "^drawer$"): [0, 1, 2]}
