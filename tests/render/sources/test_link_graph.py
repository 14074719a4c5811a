import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dataset_writers import box
from hypothesis import given
from hypothesis import strategies as st

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.sources.link_graph import FIXED, Link, LinkGraph, LinkJoint, merge_links, tree_order

FILE = Path("object.urdf")


@st.composite
def parents(draw):
    """Parent of every link of a random tree but the root, links numbered in random order."""
    count = draw(st.integers(1, 12))
    numbers = draw(st.permutations(range(count)))
    return {numbers[k]: numbers[draw(st.integers(0, k - 1))] for k in range(1, count)}, count


def edges(parent_of):
    return [SimpleNamespace(name=f"j{c}", parent=f"l{p}", child=f"l{c}") for c, p in parent_of.items()]


@given(parents())
def test_order_has_every_link_once_and_after_its_parent(tree):
    parent_of, count = tree
    order = tree_order([f"l{k}" for k in range(count)], edges(parent_of), FILE)
    assert sorted(order) == sorted(f"l{k}" for k in range(count))
    assert all(order.index(f"l{p}") < order.index(f"l{c}") for c, p in parent_of.items())


@given(parents().filter(lambda tree: tree[1] > 1), st.data())
def test_any_other_graph_is_refused(tree, data):
    parent_of, count = tree
    links = [f"l{k}" for k in range(count)]
    child = data.draw(st.sampled_from(sorted(parent_of)))
    below = [child]
    for link in below:
        below += [c for c, p in parent_of.items() if p == link]
    cyclic = {**parent_of, child: data.draw(st.sampled_from(below))}
    with pytest.raises(ValueError, match=r"object\.urdf: .*form a cycle"):
        tree_order(links, edges(cyclic), FILE)
    with pytest.raises(ValueError, match=r"object\.urdf: no single root"):
        tree_order(links, edges({c: p for c, p in parent_of.items() if c != child}), FILE)
    with pytest.raises(ValueError, match=r"object\.urdf: joint .* refers to unknown link"):
        tree_order([link for link in links if link != f"l{child}"], edges(parent_of), FILE)
    twice = [*edges(parent_of), SimpleNamespace(name="again", parent="l0", child=f"l{child}")]
    with pytest.raises(ValueError, match=r"object\.urdf: link .* is the child of two joints"):
        tree_order(links, twice, FILE)


number = st.floats(allow_nan=True, allow_infinity=True)


@given(st.tuples(number, number, number), number, number, st.sampled_from([REVOLUTE, PRISMATIC]))
def test_a_graph_has_sound_joints_or_is_not_made(axis, lower, upper, joint_type):
    links = (Link("a", box([0, 0, 0], [1, 1, 1])), Link("b", box([0, 0, 1], [1, 1, 2])))
    joint = LinkJoint("j", joint_type, "a", "b", np.array(axis), np.zeros(3), lower, upper)
    sound = np.isfinite(axis).all() and np.abs(axis).max() >= 1e-9 and lower <= upper
    sound = sound and lower < np.inf and upper > -np.inf
    if not sound:
        with pytest.raises(ValueError, match=r"object\.urdf: joint 'j' has "):
            LinkGraph(FILE, links, (joint,))
        return
    graph = LinkGraph(FILE, links, (joint,))
    if (not graph.joints[0].is_limited and joint_type == PRISMATIC) or lower == upper:
        with pytest.raises(ValueError, match=r"object\.urdf: joint 'j' has limits .*; state a range"):
            merge_links(graph, graph.joints, [1], ["a", "b"], "x", "articulated")
        return
    merged = merge_links(graph, graph.joints, [1], ["a", "b"], "x", "articulated").validate().joints[0]
    assert math.hypot(*merged.axis) == pytest.approx(1)
    largest = np.abs(axis).max()
    np.testing.assert_allclose(
        merged.axis / np.abs(merged.axis).max(), np.array(axis) / largest, rtol=1e-12, atol=1e-12
    )
    assert -np.inf < merged.lower < merged.upper < np.inf


@pytest.mark.parametrize("length", [1e-8, 1e-3, 1.0, 1e200])
def test_an_axis_of_any_length_is_a_direction(length):
    joint = LinkJoint("j", REVOLUTE, "a", "b", length * np.array([0.6, 0, -0.8]), np.zeros(3))
    np.testing.assert_allclose(joint.direction, [0.6, 0, -0.8], rtol=1e-12)


def test_links_join_the_part_of_the_nearest_modelled_joint_above():
    names = ["root", "door", "handle", "screw", "shelf"]
    links = tuple(Link(name, box([k, 0, 0], [k + 1, 1, 1])) for k, name in enumerate(names))
    axis, origin = np.array([0.0, 0, 2]), np.zeros(3)
    joints = (
        LinkJoint("s", REVOLUTE, "handle", "screw", axis, origin),
        LinkJoint("h", FIXED, "door", "handle", np.zeros(3), origin),
        LinkJoint("d", REVOLUTE, "root", "door", axis, origin, 0.0, 1.0),
        LinkJoint("f", PRISMATIC, "root", "shelf", axis, origin),
    )
    merged = merge_links(LinkGraph(FILE, links, joints), joints[2:3], [1], ["body", "door"], "x", "safe")
    np.testing.assert_allclose(merged.meshes[0].bounds, [[0, 0, 0], [5, 1, 1]])
    assert len(merged.meshes[0].faces) == 24
    np.testing.assert_allclose(merged.meshes[1].bounds, [[1, 0, 0], [4, 1, 1]])
    np.testing.assert_allclose(merged.joints[0].axis, [0, 0, 1])
