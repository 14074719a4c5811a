"""Articulated objects: re-posing, and every unsound object refused with a message that names it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from objects import box_chain, box_laptop


def test_motion_at_rest_is_identity():
    chain = box_chain()
    np.testing.assert_allclose(chain.part_motion(np.array([0.1, 0.2])), np.broadcast_to(np.eye(4), (3, 4, 4)))


def test_children_move_with_their_parents():
    motion = box_chain().part_motion(np.array([0.3, 0.2]))
    np.testing.assert_allclose(motion[1:, :3, 3], [[0, 0, 0.2]] * 2, atol=1e-12)
    np.testing.assert_allclose(motion[0], np.eye(4))


@settings(max_examples=25, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 4))
def test_storing_an_object_at_another_state_changes_no_posed_vertex(states):
    """Re-posing after `at_rest` lands every vertex where posing the original puts it."""
    chain = box_chain()
    moved = chain.at_rest(states[:2])
    target = np.array(states[2:])
    for a, b, mesh_a, mesh_b in zip(
        chain.part_motion(target), moved.part_motion(target), chain.meshes, moved.meshes, strict=True
    ):
        np.testing.assert_allclose(
            trimesh.transform_points(mesh_a.vertices, a), trimesh.transform_points(mesh_b.vertices, b), atol=1e-9
        )


def _with_joint(**changes):
    laptop = box_laptop()
    return replace(laptop, joints=(replace(laptop.joints[0], **changes),))


def _with_lid(mesh):
    laptop = box_laptop()
    return replace(laptop, meshes=(laptop.meshes[0], mesh))


def _flat_mesh():
    return trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)


def _nan_mesh():
    return trimesh.Trimesh(np.full((3, 3), np.nan), [[0, 1, 2]], process=False, validate=False)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: _with_joint(axis=np.zeros(3)), "axis of length 0"),
        (lambda: _with_joint(axis=np.array([np.nan, 0, 1])), "NaN"),
        (lambda: _with_joint(lower=2.0, upper=1.0), "reversed limits"),
        (lambda: _with_joint(lower=1.0, upper=1.0), "no motion"),
        (lambda: _with_joint(child=7), "connects parts 0 and 7"),
        (lambda: _with_joint(type=9), "unknown type 9"),
        (lambda: replace(box_laptop(), part_names=("base",)), "1 part names but 2 meshes"),
        (lambda: replace(box_laptop(), joints=()), "must be the child of one joint"),
        (lambda: _with_lid(trimesh.Trimesh()), "'lid' has no faces"),
        (lambda: _with_lid(_flat_mesh()), "'lid' has no surface area"),
        (lambda: _with_lid(_nan_mesh()), "'lid' has NaN"),
    ],
)
def test_unsound_objects_are_refused(make, message):
    with pytest.raises(ValueError, match=rf"instance 'box'.*{message}"):
        make().validate()


def test_cyclic_trees_are_refused():
    chain = box_chain()
    slide, swing = chain.joints
    with pytest.raises(ValueError, match=r"instance 'chain'.*cycle"):
        replace(chain, joints=(replace(slide, parent=2), swing)).validate()


def test_the_checksum_is_of_everything_that_clouds_are_made_from():
    chain = box_chain()
    assert box_chain().checksum() == chain.checksum()
    moved = chain.meshes[2].copy()
    moved.vertices[0] += 0.01
    others = [
        replace(chain, meshes=(*chain.meshes[:2], moved)),
        replace(chain, joints=(chain.joints[0], replace(chain.joints[1], upper=0.6))),
        replace(chain, part_names=("cabinet", "drawer", "lid")),
    ]
    assert len({chain.checksum(), *(other.checksum() for other in others)}) == 4
