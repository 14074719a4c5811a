"""Points go to the part with which they stay on the surface, and labels spread along faces."""

import numpy as np
from articulated_objects import DRAWER, clouds

from articulate_ssl.discovery.one_object.moving_labels import agreed, believed, moving_costs, spread_labels
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.shape.joints import Joints


def _world() -> tuple[list[Surface], np.ndarray, np.ndarray]:
    """Clouds of a drawer, the poses of its parts, and the parts of the points."""
    data = clouds(DRAWER, count=8, points=2048, resample=True, seed=1)
    joints = Joints(KinematicChain(2, 0, (0,), (1,)), data.axis, data.pivot, DRAWER[4])
    pose = joints.part_pose(data.base, data.state).double().numpy()
    return [Surface.of(cloud) for cloud in data.points.double().numpy()], pose, data.part.numpy()


def test_what_moves_is_told_from_what_stays():
    surfaces, pose, part = _world()
    cost = moving_costs(surfaces, pose, 2048)
    assert cost.shape == (8, 2048, 2)
    own = np.take_along_axis(cost, part[None, :, None].repeat(8, axis=0), axis=2)
    assert np.median(own) < 0.002
    exchanged = moving_costs(surfaces, pose[:, ::-1], 2048)
    np.testing.assert_allclose(exchanged, cost[..., ::-1], atol=1e-12)


def test_labels_that_spread_along_faces_are_better_than_those_of_single_points():
    surfaces, pose, part = _world()
    cost = moving_costs(surfaces, pose, 2048)
    alone = (cost.argmin(axis=-1) == part).mean()
    probability = np.stack([spread_labels(s, said) for s, said in zip(surfaces, believed(cost), strict=True)])
    np.testing.assert_allclose(probability.sum(axis=-1), 1, atol=1e-9)
    assert (probability.argmax(axis=-1) == part).mean() > alone + 0.02


def test_labels_that_clouds_agree_on_are_better_than_those_of_single_clouds():
    surfaces, pose, part = _world()
    said = believed(moving_costs(surfaces, pose, 2048))
    alone = np.stack([spread_labels(*one) for one in zip(surfaces, said, strict=True)])
    found = agreed(surfaces, pose, said)
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-9)
    right = [(probability.argmax(axis=-1) == part).mean() for probability in (alone, found)]
    assert 1 - right[1] < 0.85 * (1 - right[0])
    # Names do not matter.
    np.testing.assert_allclose(agreed(surfaces, pose[:, ::-1], said[..., ::-1])[..., ::-1], found, atol=1e-9)


def test_points_ask_those_that_they_lie_on_with_the_part_that_they_ask_about():
    """A strip that lies still and a part that steps aside: where the step leads past the strip, nothing is said of it.

    One cloud knows that it is of part 0, the other knows nothing.
    """
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.random(400), 0.1 * rng.random(400), np.zeros(400)])
    strips = [Surface.of(points), Surface.of(points + np.array([0, 0, 0.2]))]
    pose = np.tile(np.eye(4), (2, 2, 1, 1))
    pose[1, :, 2, 3] = 0.2
    pose[1, 1, 0, 3] = 5.0
    said = np.full((2, 400, 2), 0.5)
    said[0] = [0.99, 0.01]
    assert (agreed(strips, pose, said)[1, :, 0] > 0.99).all()
    pose[1, 0, 0, 3] = 5.0  # now neither part leads to the strip
    np.testing.assert_allclose(agreed(strips, pose, said)[1], 0.5, atol=1e-9)


def test_an_undecided_face_follows_its_end():
    """A strip whose last tenth belongs to part 1, and whose rest could belong to either."""
    rng = np.random.default_rng(0)
    strip = Surface.of(np.column_stack([rng.random(400), 0.1 * rng.random(400), np.zeros(400)]))
    cost = np.zeros((400, 2))
    cost[strip.points[:, 0] > 0.9, 0] = 0.02
    assert (spread_labels(strip, believed(cost)).argmax(axis=1) == 1).mean() > 0.99


def test_what_else_is_said_of_points_counts_where_motion_says_nothing():
    cost = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.02], [0.02, 0.0]])
    votes = np.array([[0.9, 0.1], [0.1, 0.9], [0.1, 0.9], [1.0, 0.0]])
    alone, both = believed(cost), believed(cost, votes)
    np.testing.assert_allclose(alone.sum(axis=-1), 1)
    np.testing.assert_allclose(both.sum(axis=-1), 1)
    np.testing.assert_allclose(alone[:2], 0.5)
    assert both.argmax(axis=-1).tolist() == [0, 1, 0, 1]
