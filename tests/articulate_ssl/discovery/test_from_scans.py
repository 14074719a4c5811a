"""From scans and depth views to views that teach: in the camera's frame, as far turned as the views are."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from articulated_objects import CHEST, LAPTOP, clouds, true_shape

from articulate_ssl.discovery import from_scans, reshaping
from articulate_ssl.discovery.from_scans import discover_from_scans
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.simulated_views import simulate_views
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.ops.chamfer import nearest_distance

POINTS = 150


def _all_stand(found, clouds, best):
    return torch.zeros(len(clouds), dtype=torch.long), torch.eye(3).expand(len(clouds), 3, 3)


@pytest.mark.parametrize("degrees", [60.0, 180.0])
def test_views_that_teach_are_turned_as_the_views_are(monkeypatch, degrees):
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)  # of the very object, whose shape is known, in other states
    data = clouds(LAPTOP, count=16, points=1024)
    error = torch.arange(16.0)
    truth = RegisteredShape(true_shape(LAPTOP, data), data.base, data.state, torch.zeros(16, 2, 3), error)
    upright = roma.rotvec_to_rotmat(torch.tensor([0.4, -1.1, 2.0]))
    turns = OrientationRange(50).draw(16, torch.Generator().manual_seed(1)) @ upright
    views, _ = simulate_views(truth, data.points, turns[:, None], 200, 0.3, np.random.default_rng(5))
    asked = []

    def grouped(*arguments):
        asked.append(arguments)
        return truth

    monkeypatch.setattr(from_scans, "discover_grouped", grouped)
    options, instance = DiscoveryOptions(grouped=True), torch.zeros(16, dtype=torch.long)
    orientation = OrientationRange(degrees)
    arguments = (views, data.points, data.points, instance, 2, LAPTOP[4], options, orientation, POINTS)
    points, found, scans = discover_from_scans(*arguments, to_stand=_all_stand)
    assert asked == [arguments[1:7]]
    # Of the same scans, fewer views, of other joint states, turned as the first of each were.
    limits = truth.limits() + 1.0
    fewer, others = scans.views(POINTS, np.random.default_rng(0), 2, limits)
    assert len(scans.clouds) == 12 and 12 < len(fewer) <= 24
    assert (others.state > limits[:, 0]).all() and (others.state < limits[:, 1]).all()
    between = roma.rotmat_geodesic_distance(others.base[:, None, :3, :3], scans.turns[:, :2].flatten(0, 1)[None])
    assert between.amin(dim=1).max() < 1e-2
    assert 11 * from_scans._VIEWS < len(points) <= 12 * from_scans._VIEWS  # of three quarters of the clouds
    assert orientation.contains(found.base[:, :3, :3]).all()
    larger = found.log_stretch[:, 0, 0].exp()
    for i in range(0, len(points), 25):
        posed = found.shape.scaled(float(larger[i])).posed(found.base[i : i + 1], found.state[i : i + 1])
        assert nearest_distance(points[i : i + 1], posed).max() < 1e-3
    # How the canonical space was turned, from the two shapes: by the mean of the views, if there is one.
    turn, _ = roma.rigid_points_registration(truth.shape.points, found.shape.points / found.shape.points.norm())
    expected = upright if orientation.limited else torch.eye(3)
    assert roma.rotmat_geodesic_distance(turn, expected).rad2deg() < (25 if orientation.limited else 0.1)


def test_what_lies_is_seen_as_it_stands_and_said_to_lie(monkeypatch):
    """Also where it fits worst, as objects do that are hinged otherwise than most; and in the mirror."""
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)
    data = clouds(LAPTOP, count=16, points=1024)
    truth = RegisteredShape(true_shape(LAPTOP, data), data.base, data.state, torch.zeros(16, 2, 3), torch.arange(16.0))
    upright = roma.rotvec_to_rotmat(torch.tensor([0.4, -1.1, 2.0]))
    turns = OrientationRange(20).draw(16, torch.Generator().manual_seed(1)) @ upright
    views, _ = simulate_views(truth, data.points, turns[:, None], 200, 0.3, np.random.default_rng(5))
    lying = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, torch.pi / 2]))
    asked = []

    def to_stand(found, clouds, best):
        asked.append(sorted(best.tolist()))
        quarters, turn = _all_stand(found, clouds, best)
        turn = turn.clone()
        quarters[[3, 15]], turn[[3, 15]] = 1, lying  # one that fits well, too
        quarters[[19, 31]], turn[[19, 31]] = 3, lying.mT  # the same in the mirror
        quarters[20] = 2  # in the mirror what stands as it is
        quarters[[5, 21]], turn[[5, 21]] = 1, lying  # one that fits upright, too
        return quarters, turn

    def lie(found, clouds, turns):
        assert found.error.tolist() == [3, 5, 15] and len(clouds) == 3 and torch.equal(turns, lying.expand(3, 3, 3))
        return torch.tensor([True, False, True])

    monkeypatch.setattr(from_scans, "lie", lie)
    monkeypatch.setattr(from_scans, "discover_grouped", lambda *_: truth)
    options, orientation = DiscoveryOptions(grouped=True), OrientationRange(100.0)
    arguments = (views, data.points, data.points, torch.zeros(16, dtype=torch.long), 2, LAPTOP[4], options)
    points, found, _ = discover_from_scans(*arguments, orientation, POINTS, to_stand=to_stand)
    assert asked == [list(range(12))]
    turn, _ = roma.rigid_points_registration(truth.shape.points, found.shape.points / found.shape.points.norm())
    # Errors say which cloud a view is of: those of 3 and 15 are 3 and 15 times its scale.
    of = (found.error / found.log_stretch[:, 0, 0].exp()).round(decimals=3)
    source = of / of[of > 0].min()
    lie = (source - 3).abs().lt(0.1) | (source - 15).abs().lt(0.1)
    assert torch.equal(lie, found.quarters > 0)
    assert len(points) > 10 * from_scans._VIEWS and ((source - 5).abs() > 0.1).all()
    for quarters, turned in ((0, torch.eye(3)), (1, lying), (3, lying.mT)):
        own = found.base[found.quarters == quarters, :3, :3]
        from_mean, stood_from_mean = (
            roma.rotmat_geodesic_distance(own @ one, torch.eye(3)[None]).rad2deg().median()
            for one in (torch.eye(3), turn @ turned @ turn.mT)
        )
        assert stood_from_mean < 45 and (from_mean > 75) == bool(quarters)
        # Two objects, as they are and in the mirror.
        assert 30 < len(own) <= 2 * from_scans._VIEWS or not quarters


def test_clouds_whose_joints_are_at_an_end_of_what_was_sought_teach_nothing(monkeypatch):
    data = clouds(LAPTOP, count=16, points=1024)
    ends = torch.tensor([[-2.0, 2.0]])
    state = data.state.clone()
    state[[1, 4]] = ends.mT  # fit well
    found = RegisteredShape(true_shape(LAPTOP, data), data.base, state, torch.zeros(16, 2, 3), torch.arange(16.0))
    monkeypatch.setattr(from_scans, "discover_grouped", lambda *_: replace(found, sought=ends))
    views, _ = simulate_views(found, data.points, data.base[:, None, :3, :3], 200, 0.3, np.random.default_rng(5))
    arguments = (views, data.points, data.points, torch.zeros(16, dtype=torch.long), 2, LAPTOP[4])
    *_, scans = discover_from_scans(
        *arguments, DiscoveryOptions(grouped=True), OrientationRange(180.0), POINTS, to_stand=_all_stand
    )
    assert scans.source.tolist() == [0, 2, 3, *range(5, 12)]
    assert scans.found.limits().abs().max() < 1.9


def test_in_the_mirror_poses_and_states_are_the_same():
    data = clouds(LAPTOP, count=4, points=1024)
    seen = data.points[:, (data.rest[:, 1] < 0.2) | (torch.arange(1024) % 2 == 0)]  # denser at one end of the hinge
    found = RegisteredShape(true_shape(LAPTOP, data), data.base, data.state, torch.zeros(4, 2, 3), torch.zeros(4))
    mirrored = from_scans._in_the_mirror(found, seen)
    posed = found.shape.posed(data.base, data.state)
    assert nearest_distance(mirrored, posed).max() < 0.06  # as far as between points
    ends = [((x - x.mean(dim=1, keepdim=True)) * (data.base[:, None, :3, 1])).sum(-1) for x in (seen, mirrored)]
    torch.testing.assert_close(ends[0], -ends[1], atol=1e-5, rtol=0)
    assert (torch.cdist(seen, seen) - torch.cdist(mirrored, mirrored)).abs().max() < 1e-3
    assert torch.linalg.det((mirrored - mirrored.mean(1, True)).mT @ (seen - seen.mean(1, True))).max() < 0


def test_chests_that_are_turned_over_are_believed_last():
    data = clouds(CHEST, count=12, points=1024, resample=True)
    base, over = data.base.clone(), roma.rotvec_to_rotmat(torch.tensor([torch.pi, 0.0, 0.0]))
    base[[2, 9], :3, :3] = base[[2, 9], :3, :3] @ over
    axes, stretch = torch.eye(3).expand(3, 3, 3), torch.zeros(12, 3, 3)
    # They fit best, which is not to be what they are believed by.
    error = torch.ones(12).scatter(0, torch.tensor([2, 9]), 0.5)
    found = RegisteredShape(true_shape(CHEST, data), base, data.state, stretch, error, axes)
    assert sorted(from_scans._likeliest(found, data.points)[-2:].tolist()) == [2, 9]
    alone = RegisteredShape(true_shape(CHEST, data), base, data.state, stretch, error)
    assert sorted(from_scans._likeliest(alone, data.points)[:2].tolist()) == [2, 9]
