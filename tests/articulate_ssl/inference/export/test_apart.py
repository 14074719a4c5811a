"""Parts that move side by side do not meet, even if some of their points were taken for the other's."""

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
import trimesh
from scan_predictions import result_of

from articulate_ssl.inference.export import mjcf, rigid_links, urdf
from articulate_ssl.inference.export.apart import MOST_BEYOND, Motion, half_spaces, kept, trimmed
from articulate_ssl.inference.export.hollow import shared_volume
from articulate_ssl.inference.export.physics_check import check
from articulate_ssl.inference.export.rigid_links import rigid_object

AXIS = np.array([0.6, 0.0, 0.8])
RANGES = torch.tensor([[-0.02, 0.3]]).repeat(3, 1)


def slides(*axes) -> list[Motion]:
    return [Motion(0, child, np.array(axis), turns=False) for child, axis in enumerate(axes, start=1)]


def doors(*axes) -> list[Motion]:
    return [Motion(0, child, np.array(axis), turns=True) for child, axis in enumerate(axes, start=1)]


def two_rods(wrong: float) -> list[np.ndarray]:
    """A body of no interest, and two rods along the axis, .1 apart in y; a share of their points is the other's."""
    rng = np.random.default_rng(0)
    along, across = rng.random((2, 400, 1)), rng.random((2, 400, 3)) * 0.1
    rods = along * AXIS + across + np.array([[[0, 0, 0]], [[0, 0.2, 0]]])
    swapped = int(wrong * 400)
    rods[:, :swapped] = rods[::-1, :swapped]
    return [np.zeros((4, 3)), *rods]


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("sign", [1, -1])
def test_points_that_were_taken_for_the_other_part_are_left_out(wrong, sign):
    points = two_rods(wrong)
    spaces = half_spaces(points, slides(AXIS, sign * AXIS))
    assert spaces[0] == [] and len(spaces[1]) == len(spaces[2]) == 1
    low, high = (kept(points[part], spaces[part]) for part in (1, 2))
    assert low[:, 1].max() <= 0.1 and high[:, 1].min() >= 0.2
    assert len(low) == len(high) == 400 - int(wrong * 400)
    for (space,) in spaces[1:]:
        assert space.normal @ AXIS == pytest.approx(0, abs=1e-9)  # where they slide changes nothing


def test_parts_that_are_in_each_other_or_slide_elsewhere_are_left_alone():
    points = two_rods(0.0)
    assert half_spaces(points, slides(AXIS, (0.0, 1.0, 0.0))) == [[], [], []]
    assert half_spaces(two_rods(MOST_BEYOND + 0.05), slides(AXIS, AXIS)) == [[], [], []]
    chain = [Motion(0, 1, AXIS, turns=False), Motion(1, 2, AXIS, turns=False)]
    assert half_spaces(points, chain) == [[], [], []]


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("sign", [1, -1])
def test_doors_above_each_other_are_kept_apart_across_their_hinges(wrong, sign):
    points = two_rods(wrong)  # stacked in y
    spaces = half_spaces(points, doors((0, 1.0, 0), (0, sign * 1.0, 0)))
    assert spaces[0] == [] and len(spaces[1]) == len(spaces[2]) == 1
    low, high = (kept(points[part], spaces[part]) for part in (1, 2))
    assert low[:, 1].max() <= 0.1 and high[:, 1].min() >= 0.2
    for (space,) in spaces[1:]:
        assert abs(space.normal[1]) == pytest.approx(1)  # turning changes nothing


def test_doors_beside_each_other_and_a_door_beside_a_drawer_are_left_alone():
    points = two_rods(0.0)
    # No plane that both doors keep to parts them: between their closed leaves is one, through which they swing.
    assert half_spaces(points, doors(AXIS, AXIS)) == [[], [], []]
    assert half_spaces(points, doors(AXIS)[:1] + slides(AXIS, AXIS)[1:]) == [[], [], []]


def test_plates_face_to_face_keep_their_points():
    plate = np.concatenate([np.random.default_rng(0).random((400, 2)), np.zeros((400, 1))], axis=1)
    points = [np.zeros((4, 3)), plate, plate + np.array([0, 0, 1e-4])]
    spaces = half_spaces(points, slides((1.0, 0, 0), (1.0, 0, 0)))
    assert len(spaces[1]) == 1 and not spaces[1][0].holds(plate).any()
    assert kept(plate, spaces[1]) is plate


def test_a_mesh_is_closed_where_it_is_cut_off():
    spaces = half_spaces(two_rods(0.0), slides(AXIS, AXIS))[1]
    block = trimesh.creation.box((0.4, 0.4, 0.4))
    cut = trimmed(block, spaces)
    assert cut.is_volume and spaces[0].holds(cut.vertices - 1e-6 * spaces[0].normal).all()
    assert 0.5 < cut.volume / block.volume < 1
    far = block.copy().apply_translation(-2 * spaces[0].normal)
    assert trimmed(far, spaces) is far


def wrong_chest():
    """The chest of `synthetic`, with a twentieth of each drawer's points from the next one."""
    prediction, points = synthetic.drawer()
    whole = prediction.part_shape + prediction.assembly[:, :, None]
    mixed = whole.clone()
    mixed[0, [1, 2, 3], :12] = whole[0, [2, 3, 1], :12]
    prediction.part_shape.copy_(mixed - prediction.assembly[:, :, None])
    return prediction, points


def test_a_chest_with_wrong_points_passes_the_check_only_so(tmp_path, monkeypatch):
    def verdict(folder):
        folder.mkdir()
        for write in (mjcf.write, urdf.write):
            write(result_of(wrong_chest, state_range=RANGES), folder)
        return check(folder)

    assert verdict(tmp_path / "apart").passed
    drawers = [link.mesh for link in rigid_object(result_of(wrong_chest, state_range=RANGES)).links[1:]]
    assert max(shared_volume(a, b) for a, b in zip(drawers, drawers[1:] + drawers[:1], strict=True)) < 1e-9
    monkeypatch.setattr(rigid_links, "half_spaces", lambda shapes, motions: [[] for _ in shapes])
    assert not verdict(tmp_path / "blocked").passed


@pytest.mark.parametrize("part", [0, 1])
@pytest.mark.parametrize("flat", [(0, 0, 0), (1, 0, 0), (1, 1, 0)], ids=["one place", "a line", "a plane"])
def test_parts_without_volume_are_exported_too(flat, part):
    prediction, points = synthetic.drawer()
    prediction.part_shape[0, part] *= torch.tensor(flat)
    thing = rigid_object(result_of(lambda: (prediction, points), state_range=RANGES))
    for link in thing.links:
        assert link.mesh.is_watertight and link.mass > 0
