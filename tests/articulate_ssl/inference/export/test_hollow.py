"""Where parts slide, the part they slide on is hollow."""

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
import trimesh
from scan_predictions import result_of

from articulate_ssl.inference.export import mjcf, urdf
from articulate_ssl.inference.export.hollow import (
    Slide,
    closed_difference,
    hollow_parents,
    lies_inside,
    shared_volume,
    swept,
)
from articulate_ssl.inference.export.part_mesh import part_mesh
from articulate_ssl.inference.export.physics_check import OVERLAP_WORTH_A_NOTE, check
from articulate_ssl.inference.export.rigid_links import rigid_object

CHEST = dict(state_range=torch.tensor([[-0.02, 0.3]]).repeat(3, 1))


def box(extents, center) -> trimesh.Trimesh:
    return trimesh.creation.box(extents, trimesh.transformations.translation_matrix(center))


@pytest.mark.parametrize("scale", [1.0, 300.0, 1e-3])
def test_drawers_of_a_chest_share_no_volume_with_it_in_any_state(scale):
    thing = rigid_object(result_of(synthetic.drawer, scale=scale, **CHEST))
    body = thing.links[0].mesh
    solid = part_mesh(body.vertices)
    for joint in thing.joints:
        drawer = thing.links[joint.child].mesh
        for state in np.linspace(joint.lower, joint.upper, 5):
            moved = drawer.copy().apply_translation(state * joint.axis)
            assert shared_volume(moved, body) < 1e-3 * drawer.volume
            assert state > 0.2 * scale or shared_volume(moved, solid) > 0.5 * drawer.volume
    grown = body.copy().apply_scale(1 / scale)
    assert grown.is_volume
    # What is left is the block without three boxes.
    assert grown.volume == pytest.approx(0.5 * 0.5 * 0.65 - 3 * 0.4 * 0.47 * 0.16, rel=0.12)


def test_a_chest_passes_the_check_without_a_note(tmp_path):
    result = result_of(synthetic.drawer, **CHEST)
    for write in (mjcf.write, urdf.write):
        write(result, tmp_path)
    verdict = check(tmp_path)
    assert verdict.passed, verdict.lines()
    assert all(file.overlap < OVERLAP_WORTH_A_NOTE for file in verdict.files)


def test_what_turns_or_only_touches_leaves_meshes_as_they_are():
    laptop = rigid_object(result_of(synthetic.laptop))
    meshes = [link.mesh for link in laptop.links]
    assert all(link.mesh.is_convex for link in laptop.links)
    plate, slide = box((1, 1, 0.1), (0, 0, 0)), Slide(0, 1, np.array([1.0, 0, 0]), 0.0, 0.5)
    assert not lies_inside(box((0.2, 0.2, 0.2), (0, 0, 0.15)), plate, slide)
    assert lies_inside(box((0.2, 0.2, 0.2), (0, 0, 0.1)), plate, slide)
    assert not lies_inside(box((0.2, 0.2, 0.2), (0.65, 0, 0)), plate, slide)
    assert lies_inside(box((0.2, 0.2, 0.2), (0.65, 0, 0)), plate, slide._replace(lower=-0.2))
    assert [*map(id, hollow_parents(meshes, []))] == [*map(id, meshes)]


def test_what_would_swallow_the_whole_part_is_not_cut_out():
    block = box((0.4, 0.4, 0.4), (0, 0, 0))
    sweep = swept(box((0.5, 0.5, 0.5), (0, 0, 0)), Slide(0, 1, np.array([0, 0, 1.0]), 0.0, 0.1))
    assert closed_difference(block, [sweep]) is block


def test_splinters_are_left_out():
    block = box((1.0, 1.0, 1.0), (0, 0, 0))
    wide = box((0.5, 1.2, 1.2), (0.247, 0, 0))  # leaves a wall on one side, and hardly anything on the other
    left = closed_difference(block, [wide])
    assert left.is_volume and left.body_count == 1
    assert left.volume == pytest.approx(0.497, rel=0.01)
