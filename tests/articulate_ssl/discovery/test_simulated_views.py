"""Views that are simulated show what a camera sees, and say truly where the shape is in them."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from articulated_objects import DRAWER, LAPTOP, clouds, true_shape

from articulate_ssl.discovery import reshaping
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.simulated_views import simulate_views
from articulate_ssl.discovery.view_orientations import ViewOrientations, find_view_orientations
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.ops.chamfer import nearest_distance

POINTS = 100


def _registered(design, count: int = 6) -> tuple[torch.Tensor, RegisteredShape]:
    data = clouds(design, count=count, points=1024)
    stretch = torch.zeros(count, 2, 3)
    return data.points, RegisteredShape(true_shape(design, data), data.base, data.state, stretch, torch.zeros(count))


def _views(design, degrees: float = 60.0, views: int = 3):
    points, found = _registered(design)
    turns = OrientationRange(degrees).draw(len(points) * views, torch.Generator().manual_seed(0))
    turns = turns.unflatten(0, (-1, views))
    seen, registered = simulate_views(found, points, turns, POINTS, 0.3, np.random.default_rng(0))
    return turns.transpose(0, 1).flatten(0, 1), seen, registered


@pytest.mark.parametrize("design", [LAPTOP, DRAWER], ids=["laptop", "drawer"])
def test_the_shape_lies_where_the_view_shows_it(design):
    turns, seen, registered = _views(design)
    assert seen.shape == (18, POINTS, 3) and len(registered.base) == 18
    torch.testing.assert_close(registered.base[:, :3, :3], turns)
    fit = registered.fit(torch.Generator())
    larger = replace(registered, log_stretch=registered.log_stretch).log_stretch[:, 0, 0].exp()
    assert larger.log().mean().abs() < 1e-5 and larger.std() > 0.01
    # In a view's own scale the whole shape, as large as there, passes through every point that is seen.
    for view, base, state, own in zip(seen, registered.base, registered.state, larger, strict=True):
        posed = registered.shape.scaled(float(own)).posed(base[None], state[None])
        assert nearest_distance(view[None], posed).max() < 1e-3
    assert fit.error(seen).shape == (18,)


def test_parts_lie_elsewhere_in_views_as_they_did():
    _, found = _registered(DRAWER)
    center = found.shape.part(0).mean(dim=0)  # about which a view's size stretches: canonical origins are about there
    joints = replace(found.shape.joints, pivot=found.shape.joints.pivot - center)
    shape = replace(found.shape, points=found.shape.points - center, joints=joints)
    beside = torch.tensor([[0.0, 0, 0], [0.3, 0.2, 0.1]]).expand(6, 2, 3)
    found = replace(found, shape=shape, axes=torch.eye(3).expand(2, 3, 3), beside=beside)
    points = found.fit(torch.Generator()).posed()
    turns = OrientationRange(60).draw(6, torch.Generator().manual_seed(0))[:, None]
    seen, registered = simulate_views(found, points, turns, POINTS, 0.3, np.random.default_rng(0))
    assert registered.log_stretch.std() > 0.01
    assert nearest_distance(seen, registered.fit(torch.Generator()).posed()).max() < 1e-3


def test_views_are_normalised_and_the_far_side_is_hidden():
    _, seen, registered = _views(LAPTOP)
    assert (seen.norm(dim=-1).mean(dim=1) - 0.3).abs().max() < 0.06  # few points, spread evenly: not as pixels are
    posed = registered.shape.posed(registered.base, registered.state)
    far = (posed[..., 2].amax(dim=1) - seen[..., 2].amax(dim=1)).mean()
    near = (seen[..., 2].amin(dim=1) - posed[..., 2].amin(dim=1)).mean()
    assert far > near  # the camera looks along z


@pytest.mark.parametrize("reshape", [False, True])
@pytest.mark.parametrize("design", [LAPTOP, DRAWER], ids=["laptop", "drawer"])
def test_the_part_of_every_point_is_known(design, reshape, monkeypatch):
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)  # of the very object, in other states
    points, found = _registered(design)
    turns = OrientationRange(60).draw(6, torch.Generator().manual_seed(0))[:, None]
    seen, registered = simulate_views(found, points, turns, POINTS, 0.3, np.random.default_rng(0), reshape=reshape)
    larger = registered.log_stretch[:, 0, 0].exp()
    for i, view in enumerate(seen):
        shape = registered.shape.scaled(float(larger[i]))
        posed = shape.posed(registered.base[i, None], registered.state[i, None])[0]
        distance = torch.stack([torch.cdist(view, posed[shape.label == k]).amin(dim=1) for k in range(2)], dim=1)
        assert distance.gather(1, registered.point_part[i, :, None]).max() < 1e-3
        assert (distance.argmin(dim=1) == registered.point_part[i]).double().mean() > 0.95  # they touch
    assert registered.point_part.unique().tolist() == [0, 1]


def test_views_of_too_few_points_are_left_out():
    points, found = _registered(LAPTOP)
    turns = OrientationRange(60).draw(len(points), torch.Generator().manual_seed(0))[:, None]
    few, registered = simulate_views(found, points, turns, 330, 0.3, np.random.default_rng(0))
    assert 0 < len(few) == len(registered.base) < len(points)
    with pytest.raises(DiscoveryError, match="shows 1000 points"):
        simulate_views(found, points, turns, 1000, 0.3, np.random.default_rng(0))


def _upright(azimuth: float, roll: float, count: int) -> torch.Tensor:
    """Orientations before a camera that goes round objects and is nearly upright (degrees)."""
    generator = torch.Generator().manual_seed(1)
    angles = (2 * torch.rand(count, 2, generator=generator) - 1) * torch.tensor([azimuth, roll]).deg2rad()
    return roma.euler_to_rotmat("YZ", angles)


def _all_sides(found, points, views: int):
    turns = OrientationRange().draw(len(points) * views, torch.Generator().manual_seed(3)).unflatten(0, (-1, views))
    seen, shown = simulate_views(found, points, turns, 200, 0.3, np.random.default_rng(1))
    return seen, shown.base[:, :3, :3]


def test_how_views_are_turned_is_found():
    points, found = _registered(LAPTOP, count=48)
    mean = roma.rotvec_to_rotmat(torch.tensor([0.4, -1.1, 2.0]))
    turns = (_upright(50, 8, len(points)) @ mean)[:, None]
    seen, registered = simulate_views(found, points, turns, 200, 0.3, np.random.default_rng(0))
    stand = find_view_orientations(seen, *_all_sides(found, points, 20))
    expected = roma.special_procrustes(registered.base[:, :3, :3].mean(dim=0))
    assert roma.rotmat_geodesic_distance(stand.mean, expected).rad2deg() < 10
    # Measured up to a turn of the camera's frame by the error of the mean: largest about its y.
    assert stand.covariance[1, 1] > 2 * stand.covariance[2, 2]
    assert 20 < stand.covariance[1, 1].sqrt().rad2deg() < 45  # 50 / sqrt(3) degrees


def test_how_chests_of_other_proportions_are_turned_is_found():
    """Wide ones and tall ones: the shape of one, registered, would stand on its side."""
    data = clouds(DRAWER, count=128, points=1024, resample=True, proportions=0.3)
    no_stretch = torch.zeros(128, 2, 3)
    found = RegisteredShape(true_shape(DRAWER, data), data.base, data.state, no_stretch, torch.zeros(128))
    mean = roma.rotvec_to_rotmat(torch.tensor([0.4, -1.1, 2.0]))
    turns = (_upright(40, 8, 96) @ mean)[:, None]
    shown, scanned = slice(96), slice(96, 128)
    seen, registered = simulate_views(
        found.of_clouds(shown), data.points[shown], turns, 200, 0.3, np.random.default_rng(0)
    )
    stand = find_view_orientations(seen, *_all_sides(found.of_clouds(scanned), data.points[scanned], 40))
    expected = roma.special_procrustes(registered.base[:, :3, :3].mean(dim=0))
    assert roma.rotmat_geodesic_distance(stand.mean, expected).rad2deg() < 15


def test_drawn_views_are_turned_as_measured_and_stay_within_the_range():
    covariance = torch.diag(torch.tensor([0.1, 0.5, 0.02]))
    stand, orientation = ViewOrientations(torch.eye(3), covariance), OrientationRange(70)
    drawn = stand.draw(2000, orientation, torch.Generator().manual_seed(0))
    assert drawn.shape == (2000, 3, 3) and orientation.contains(drawn).all()
    torch.testing.assert_close(torch.linalg.det(drawn), torch.ones(2000))
    spread = roma.rotmat_to_rotvec(drawn).std(dim=0)
    assert spread[1] > 1.3 * spread[0] > 1.6 * spread[2] > 0.2
    assert torch.equal(drawn, stand.draw(2000, orientation, torch.Generator().manual_seed(0)))
