import logging
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from PIL import Image, ImageSequence
from scan_predictions import OBJECTS, result_of

from articulate_ssl.inference.export import animation

WIDE = torch.tensor([[0.2, 1.6]])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A frame takes a seventh of a second."""
    monkeypatch.setattr(animation, "FRAMES", 4)
    monkeypatch.setattr(animation, "MAX_DRAWN_POINTS", 64)


def frames_of(file) -> list[np.ndarray]:
    with Image.open(file) as picture:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(picture)]


def without_joints():
    """The case alone, of a prediction that has one part."""
    return synthetic.chain_of_boxes([((0.8, 0.55, 0.04), (0, 0, 0))], [], [])


@pytest.mark.parametrize("upright", [False, True])
def test_the_object_moves_and_comes_back(tmp_path, upright):
    result = result_of(synthetic.laptop, state_range=WIDE, upright=upright)
    assert animation.write(result, tmp_path) == [tmp_path / "moving.gif"]
    frames = frames_of(tmp_path / "moving.gif")
    assert len(frames) == animation.FRAMES
    assert (frames[0] == frames[-1]).all()
    for before, after in pairwise(frames):
        assert (before != after).any(axis=2).mean() > 0.01
    for frame in frames:  # nothing is cut off, and a white page shows no border
        border = np.concatenate([frame[0], frame[-1], frame[:, 0], frame[:, -1]])
        assert (border == 255).all()


def test_it_repeats_for_ever_at_the_promised_size_and_holds_the_prediction(tmp_path):
    animation.write(result_of(synthetic.laptop, state_range=WIDE), tmp_path)
    with Image.open(tmp_path / "moving.gif") as picture:
        assert (picture.format, picture.size, picture.info["loop"]) == ("GIF", (480, 400), 0)
        seconds = [frame.info["duration"] / 1000 for frame in ImageSequence.Iterator(picture)]
    assert seconds[0] == animation.FIRST_SECONDS
    assert set(seconds[1:]) == {animation.FRAME_SECONDS}


def test_every_frame_is_told(tmp_path, caplog):
    with caplog.at_level(logging.INFO, logger="articulate_ssl"):
        animation.write(result_of(synthetic.laptop, state_range=WIDE), tmp_path)
    told = [record.stage for record in caplog.records if hasattr(record, "stage")]
    assert {stage.work for stage in told} == {"drawing moving.gif"}
    assert [(stage.done, stage.total) for stage in told] == [(i, animation.FRAMES) for i in range(animation.FRAMES + 1)]


def test_the_bytes_are_the_same_every_time_and_nothing_else_is_left(tmp_path):
    result = result_of(synthetic.laptop, state_range=WIDE)
    (file,) = animation.write(result, tmp_path)
    first = file.read_bytes()
    animation.write(result, tmp_path)
    assert file.read_bytes() == first
    assert list(tmp_path.iterdir()) == [file]


def test_an_object_without_joints_stands_still(tmp_path):
    (file,) = animation.write(result_of(without_joints, state_range=torch.zeros(0, 2)), tmp_path)
    assert len(frames_of(file)) == 1


@pytest.mark.parametrize("make", OBJECTS)
@pytest.mark.parametrize("count", [1, 10, 30])
def test_the_joints_move_one_after_the_other_and_reach_both_limits(make, count, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", count)
    result = result_of(make)
    limits = result.limits.numpy()
    path = animation._path(result.states, limits)
    assert (path[0] == result.states).all()
    np.testing.assert_allclose(path[-1], result.states, atol=1e-12)
    assert ((np.abs(np.diff(path, axis=0)) > 1e-9).sum(axis=1) <= 1).all()
    np.testing.assert_allclose(path.min(axis=0), np.minimum(limits[:, 0], result.states), atol=1e-12)
    np.testing.assert_allclose(path.max(axis=0), np.maximum(limits[:, 1], result.states), atol=1e-12)
    assert len(path) <= max(count, 1 + animation.MIN_FRAMES_PER_JOINT * len(limits))


def test_a_long_way_takes_more_steps_than_a_short_one_and_begins_slowly():
    states = animation._sweep(np.array([0.1, 1.0, 0.0, 0.1]), 29)
    up, down = int(np.argmax(states)) + 1, int(np.argmin(states)) + 1
    assert len(states) - down < up < down - up
    speed = np.abs(np.diff(states[up - 1 : down]))
    assert speed[0] < speed.max() / 3 > speed[-1]


def test_a_joint_without_a_range_keeps_its_state():
    result = result_of(synthetic.laptop)
    still = replace(result, limits=torch.from_numpy(result.states)[:, None].expand(1, 2))
    assert (animation._path(still.states, still.limits.numpy()) == still.states).all()
