"""Reshaped clouds are those of another object: the one of these proportions, in these joint states."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, OVEN, clouds, true_shape
from torch.nn import functional

from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.reshaping import Reshaping
from articulate_ssl.shape.object_axes import object_axes
from articulate_ssl.shape.stretch import hinged, principal_directions, stretch_matrices

COUNT = 5
designs = pytest.mark.parametrize(
    "design", [LAPTOP, OVEN, DRAWER, GLASSES], ids=["laptop", "oven", "drawer", "eyeglasses"]
)


def _registered(design, points: int = 300) -> tuple[torch.Tensor, RegisteredShape]:
    data = clouds(design, count=COUNT, points=points)
    shape = true_shape(design, data)
    stretch = torch.zeros(COUNT, shape.num_parts, 3)
    return data.points, RegisteredShape(shape, data.base, data.state, stretch, torch.zeros(COUNT))


def _drawn(joints: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return 0.3 * torch.randn(COUNT, 3, generator=generator), 0.2 * torch.randn(COUNT, joints, generator=generator)


@designs
def test_points_lie_where_those_of_such_an_object_do(design):
    points, found = _registered(design)
    log_size, state = _drawn(found.state.shape[1])
    size, joints = log_size.exp(), found.shape.joints
    reshaped = Reshaping(found, points).at(log_size[:, object_axes(found.shape).abs().argmax(dim=0)], state)
    for i in range(COUNT):
        larger = replace(
            found.shape, points=size[i] * found.shape.points, joints=replace(joints, pivot=size[i] * joints.pivot)
        )
        torch.testing.assert_close(reshaped.points[i], larger.posed(found.base[i, None], state[i, None])[0])
    assert (reshaped.points - points).norm(dim=-1).mean() > 0.03


@pytest.mark.parametrize("along_given_axes", [False, True])
def test_what_is_registered_with_a_stretch_is_taken_with_it(along_given_axes):
    """Points at rest are those of the instance, about whose own pivots its parts turn."""
    _, found = _registered(LAPTOP)
    stretch = torch.tensor([0.2, -0.1, 0.1]).expand(COUNT, 2, 3)
    own = torch.stack([principal_directions(found.shape.part(part)) for part in range(2)])
    axes = torch.eye(3).repeat(2, 1, 1) if along_given_axes else own
    found = replace(found, log_stretch=stretch, axes=axes if along_given_axes else None)
    maps, pivot = hinged(stretch_matrices(axes, stretch), found.shape.part(0).mean(dim=0), found.shape.joints)
    rest, joints = maps.move(found.shape.points, found.shape.label), replace(found.shape.joints, pivot=pivot)
    instances = replace(found.shape, points=rest, joints=joints)
    state = torch.full((COUNT, 1), -0.4)
    reshaped = Reshaping(found, instances.posed(found.base, found.state)).at(torch.zeros(COUNT, 3), state)
    torch.testing.assert_close(reshaped.points, instances.posed(found.base, state), atol=2e-5, rtol=0)


def test_nothing_changes_where_nothing_is_asked_for():
    points, found = _registered(OVEN)
    reshaping = Reshaping(found, points)
    same = reshaping.at(torch.zeros(COUNT, 3), found.state)
    for value, kept in zip(same, reshaping.unchanged(), strict=True):
        torch.testing.assert_close(value, kept, atol=1e-5, rtol=0)


def test_normals_stay_at_right_angles_to_the_surface():
    """Of an ellipsoid, with a part that turns; those of boxes along the axes would stay right by accident."""
    _, found = _registered(LAPTOP, points=2000)
    sphere = functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    found = replace(found, shape=replace(found.shape, points=sphere, label=(sphere[:, 0] > 0).long()))
    reshaping, (log_size, state) = Reshaping(found, found.shape.posed(found.base, found.state)), _drawn(1)
    reshaped, axes = reshaping.at(log_size, state), object_axes(found.shape)
    expected = functional.normalize((sphere @ axes / log_size.exp()[:, None]) @ axes.T, dim=-1)
    size = (axes * log_size.exp()[:, None]) @ axes.T
    joints = replace(found.shape.joints, axis=found.shape.joints.axis, pivot=found.shape.joints.pivot @ size)
    turn = joints.part_pose(found.base, state)[:, found.shape.label, :3, :3]
    cosine = (torch.einsum("npij,npj->npi", turn, expected) * reshaped.normals).sum(dim=-1).abs()
    assert cosine.quantile(0.1) > 0.98 and cosine.median() > 0.999


def test_draws_are_repeatable_and_within_what_the_clouds_show():
    points, found = _registered(OVEN)
    first, again, other = (Reshaping(found, points).draw(torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert torch.equal(first.points, again.points) and not torch.equal(first.points, other.points)
    low, high = found.limits().unbind(-1)
    assert (first.state >= low).all() and (first.state <= high).all()
    size = [cloud.amax(dim=1) - cloud.amin(dim=1) for cloud in (first.points, points)]
    assert (size[0] / size[1]).log().abs().amax() < 1  # nothing flies apart


def test_draws_are_between_limits_where_these_are_given():
    points, found = _registered(OVEN)
    limits = found.limits() + 3.0
    drawn = Reshaping(found, points).draw(torch.Generator().manual_seed(0), limits)
    assert (drawn.state > limits[:, 0]).all() and (drawn.state < limits[:, 1]).all()


def test_points_of_what_lies_beside_its_slide_are_told_by_where_it_lies():
    """A drawer as high as its body, but for a fifth of the chest's size farther up than the template's."""
    points, found = _registered(DRAWER)
    beside = torch.zeros(COUNT, 2, 3)
    beside[:, 1, 2] = 0.2
    moved = replace(found.shape, points=found.shape.points + beside[0, found.shape.label])
    found = replace(found, axes=torch.eye(3).repeat(2, 1, 1), beside=beside)
    points = moved.posed(found.base, found.state)
    part = Reshaping(found, points).point_part
    assert (part == moved.label).all()
    assert (Reshaping(replace(found, beside=None), points).point_part == moved.label).double().mean() < 0.98


def test_parts_that_are_known_are_what_moves():
    points, found = _registered(DRAWER)
    state = found.state + 0.2
    known = Reshaping(replace(found, point_part=found.shape.label.expand(COUNT, -1)), points)
    still = Reshaping(replace(found, point_part=torch.zeros(COUNT, 300, dtype=torch.int64)), points)
    torch.testing.assert_close(known.at(torch.zeros(COUNT, 3), state).points, found.shape.posed(found.base, state))
    torch.testing.assert_close(still.at(torch.zeros(COUNT, 3), state).points, points)
