"""A twin of one object: its scans in, the same object as each shows it out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from articulated_objects import Clouds
from twin_objects import SCALE, drawer, scans, with_little_effort

from articulate_ssl.inference.articulation import articulate, posed_parts
from articulate_ssl.inference.twin import Twin, find_twin


@pytest.fixture(scope="module")
def world():
    patch = pytest.MonkeyPatch()
    with_little_effort(patch)
    data = drawer()
    yield data, find_twin(scans(data), 2, "prismatic")
    patch.undo()


def test_every_scan_is_predicted_in_its_own_frame_and_unit(world: tuple[Clouds, Twin]):
    data, twin = world
    assert len(twin.scans) == 8
    for scan, cloud in zip(twin.scans, scans(data), strict=True):
        np.testing.assert_array_equal(scan.cloud, cloud)
        assert len(scan.part_id) == len(cloud)
        assert scan.relative_error < 0.3
        surface = posed_parts(scan.prediction)[0].flatten(0, 1).numpy()
        assert np.abs(surface.mean(axis=0) - cloud.mean(axis=0)).max() < 0.1 * SCALE


def test_states_are_those_of_the_scans_up_to_where_zero_is(world):
    data, twin = world
    assert twin.states.shape == (8, 1)
    slope, _ = np.polyfit(data.state[:, 0].numpy() * SCALE, twin.states[:, 0], 1)
    assert abs(slope) == pytest.approx(1, abs=0.02)
    assert twin.misfit < 0.005 and twin.unexplained < 0.1


def test_shapes_and_joints_are_the_same_in_all_scans(world):
    first, *others = (scan.prediction for scan in world[1].scans)
    for other in others:
        torch.testing.assert_close(other.part_shape, first.part_shape)
        torch.testing.assert_close(other.canonical_axis, first.canonical_axis)
    # The first scan's object in the state of another is the other's, but for where it stands.
    moved = articulate(first, others[0].joint_state)
    there = articulate(replace(others[0], base_pose=first.base_pose), others[0].joint_state)
    torch.testing.assert_close(moved, there)


def test_limits_hold_every_state(world):
    twin = world[1]
    low, high = twin.scans[0].limits[0].tolist()
    assert low == pytest.approx(twin.states.min()) and high == pytest.approx(twin.states.max())


def test_the_export_holds_the_states_of_all_scans(world, tmp_path):
    twin, names = world[1], [f"{i}.ply" for i in range(8)]
    files = twin.export(str(tmp_path / "out"), names, formats=["json", "urdf"])
    states = json.loads((tmp_path / "out" / "states.json").read_text())
    assert tmp_path / "out" / "states.json" in files and tmp_path / "out" / "object.urdf" in files
    assert list(states) == names
    np.testing.assert_allclose([states[name]["state"] for name in names], twin.states)


@pytest.mark.parametrize(("names", "error"), [(["a", "b"] * 4, "called a, b"), (["a"], "shorter|longer")])
def test_names_that_do_not_tell_the_scans_apart_are_refused_before_anything_is_written(world, tmp_path, names, error):
    with pytest.raises(ValueError, match=error):
        world[1].export(tmp_path / "out", names, formats=["json"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("parts", "joint", "message"), [(2, "ball", "joint must be"), (1, "revolute", "at least 2")])
def test_what_makes_no_sense_is_refused(parts, joint, message):
    with pytest.raises(ValueError, match=message):
        find_twin([], parts, joint)
