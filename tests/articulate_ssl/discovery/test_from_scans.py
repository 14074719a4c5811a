"""From scans and depth views to views that teach: in the camera's frame, as far turned as the views are."""

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
    points, found = discover_from_scans(*arguments)
    assert asked == [arguments[1:7]]
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
