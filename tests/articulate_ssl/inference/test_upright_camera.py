"""An upright camera knows which way is up: what lies on its side is turned about its door's normal until it stands."""

import math

import pytest
import roma
import torch

from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.inference.upright_camera import FEWEST, UprightCamera
from articulate_ssl.shape.observation import FAR, Observation

X, Y, Z = torch.eye(3)
# Of a box in a canonical space that is turned by a mean view: hinge, up, door's normal.
AXES = roma.rotvec_to_rotmat(torch.tensor([-0.6, 0.0, 0.0]))


def _views(count: int, lying: int = 0, up: torch.Tensor = Y) -> torch.Tensor:
    """Rotations of objects that a camera sees from sides and somewhat from above, relative to their mean."""
    generator = torch.Generator().manual_seed(1)
    azimuth = (torch.rand(count, 1, generator=generator) - 0.5) * 2.2 * up
    elevation = (torch.rand(count, 1, generator=generator) - 0.5) * 0.8 * X
    object_to_camera = roma.rotvec_to_rotmat(elevation) @ AXES @ roma.rotvec_to_rotmat(azimuth)
    turn = roma.rotvec_to_rotmat(torch.where(torch.arange(count)[:, None] < lying, 1.0, 0.0) * math.pi / 2 * Z)
    return object_to_camera @ turn @ AXES.mT  # canonical -> camera


@pytest.fixture
def camera() -> UprightCamera:
    camera = UprightCamera()
    camera.learn(_views(300, lying=40), AXES)
    return camera


def test_up_is_what_is_least_spread(camera):
    assert camera.learnt
    torch.testing.assert_close(camera.up, AXES[:, 1])
    assert float(camera.vertical @ (AXES @ Y)) > math.cos(math.radians(10))


def test_what_lies_is_turned_until_it_stands_and_the_rest_is_left(camera):
    views = _views(300, lying=40)
    turned, quarters, stands = camera.stood(views)
    assert stands.all()
    assert (quarters[40:] == 0).all() and (quarters[:40] == 3).all()
    torch.testing.assert_close(turned, _views(300), atol=1e-5, rtol=0)


def test_what_lies_on_its_back_stands_no_way(camera):
    on_its_back = _views(50) @ roma.rotvec_to_rotmat(math.pi / 2 * AXES[:, 0])
    assert not camera.stood(on_its_back)[2].any()


def test_double_precision_and_more_dimensions(camera):
    views = _views(12).double()
    one, many = camera.stood(views), camera.stood(views.view(3, 4, 3, 3))
    assert one[0].dtype == torch.float64
    for a, b in zip(one, many, strict=True):
        torch.testing.assert_close(a, b.flatten(0, 1))


def test_nothing_is_learnt_where_the_doors_normal_points_up():
    """A laptop's closed lid looks up: which way its keyboard points, an upright camera does not know."""
    camera = UprightCamera()
    camera.learn(_views(300, up=Z), AXES)
    assert not camera.learnt
    camera.learn(_views(300, up=Y), AXES)
    assert camera.learnt


def test_few_views_teach_nothing():
    camera = UprightCamera()
    camera.learn(_views(FEWEST - 1), AXES)
    assert not camera.learnt
    camera.learn(_views(FEWEST), AXES)
    assert camera.learnt
    camera.forget()
    assert not camera.learnt


def test_the_range_counts_once_objects_stand(camera):
    """Lying and seen from far aside, an object is turned by more than the range, and yet may be."""
    degrees = 80.0
    plain = Observation(OrientationRange(degrees))
    knows = Observation(OrientationRange(degrees), camera=camera)
    views, lying = _views(300), _views(300, lying=300)
    assert plain.allows(views).all() and knows.allows(views).all()
    assert not plain.allows(lying).all() and knows.allows(lying).all()
    on_its_back = views @ roma.rotvec_to_rotmat(math.radians(70) * AXES[:, 0])
    assert plain.allows(on_its_back).any() and not knows.allows(on_its_back).any()
    error = torch.zeros(300)
    assert (knows.ranked(error, on_its_back) == FAR).all() and (knows.ranked(error, lying) == 0).all()
    far = views @ roma.rotvec_to_rotmat(2.0 * AXES[:, 1])
    assert not knows.allows(far).all()
    camera.forget()
    assert (knows.allows(lying) == plain.allows(lying)).all()
