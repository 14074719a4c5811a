"""An object is understood as others are, and by how it moves itself."""

import pytest
import roma
import torch
from articulated_objects import CHEST, Clouds, clouds, true_shape

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.as_others import find_as_others, turned_alike
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import transform_points

# Drawers that part at another height than those of `CHEST`.
OTHER = (
    [((-0.4, 0, 0), (0.4, 0.6, 0.02)), ((0.02, 0.05, 0.1), (0.41, 0.55, 0.3)), ((0.02, 0.05, 0.36), (0.41, 0.55, 0.5))],
    *CHEST[1:],
)


def _object(design, seed: int) -> Clouds:
    return clouds(design, count=8, points=2048, resample=True, seed=seed)


def _labelled(data: Clouds) -> LabelledClouds:
    """The clouds as they stand, with the parts that they have."""
    boxes, _, _ = unit_boxes(transform_points(torch.linalg.inv(data.base), data.points))
    return LabelledClouds(boxes, data.part.expand(len(boxes), -1))


def _turns(data: Clouds, first: torch.Tensor) -> torch.Tensor:
    """Four turns of each cloud, of which the one of that number is right."""
    wrong = rotation_group(24).elements[[3, 7, 11]].to(data.base)
    every = torch.cat([torch.eye(3)[None], wrong]) @ data.base[:, None, :3, :3].mT
    order = (torch.arange(4) - first[:, None]) % 4
    return every.gather(1, order[..., None, None].expand(-1, -1, 3, 3))


@pytest.fixture(scope="module")
def other():
    return _object(OTHER, seed=1)


def test_parts_are_better_than_what_clouds_of_others_say_and_have_their_names(other):
    labelled, first = _labelled(_object(CHEST, seed=0)), torch.tensor([0, 0, 1, 0, 0, 2, 0, 0])
    joints = true_shape(CHEST, other).joints
    boxes = unit_boxes(transform_points(torch.linalg.inv(other.base), other.points))[0]
    said = (labelled.votes(boxes, 3).argmax(dim=-1) == other.part).float().mean()
    found, turn = find_as_others(other.points, _turns(other, first), labelled, joints)
    right = (found.label == other.part).float().mean()
    assert right > 0.97 and right > said + 0.02
    assert roma.rotmat_geodesic_distance(turn, other.base[:, :3, :3].mT).max() < 0.01
    slid, truth = (state.float() - state.float().mean(dim=0) for state in (found.state, other.state))
    torch.testing.assert_close(slid, truth, atol=0.03, rtol=0)  # a floor hardly says how far it has slid itself
    torch.testing.assert_close(slid.diff(dim=1), truth.diff(dim=1), atol=0.01, rtol=0)
    assert found.shape.joints.chain == joints.chain


def test_clouds_of_one_object_are_turned_as_most_of_them_are(other):
    first = torch.tensor([0, 1, 0, 3, 0, 0, 2, 0])
    turn = turned_alike(_turns(other, first), other.points)
    torch.testing.assert_close(turn, other.base[:, :3, :3].mT)
    torch.testing.assert_close(turned_alike(_turns(other, first)[:, :1], other.points), _turns(other, first)[:, 0])


def test_what_is_not_one_object_is_refused(other):
    another = _object(CHEST, seed=2)
    mixed = torch.cat([other.points[:4], 1.4 * another.points[4:]])
    turns = torch.cat([other.base[:4, None, :3, :3].mT, another.base[4:, None, :3, :3].mT])
    with pytest.raises(DiscoveryError, match=r"of the points of its clouds lie off|parts are left"):
        find_as_others(mixed, turns, _labelled(another), true_shape(CHEST, another).joints)
