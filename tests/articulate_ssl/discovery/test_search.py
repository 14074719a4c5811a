"""A search finds an articulated shape from any orientation, and keeps hypotheses that differ."""

import roma
import torch
from articulated_objects import LAPTOP, clouds, true_shape

from articulate_ssl.discovery.search import different, search_articulated
from articulate_ssl.geometry.rotation_group import rotation_group


def _degrees(a, b):
    return roma.rotmat_geodesic_distance(a[..., :3, :3], b[..., :3, :3]).rad2deg().max().item()


def test_a_search_rights_an_object_from_any_orientation():
    data = clouds(LAPTOP, count=4)
    shape = true_shape(LAPTOP, data)
    states = torch.tensor([[-0.4], [-1.2]])
    base, state, error = search_articulated(shape, data.points, rotation_group(60).elements.float(), states)
    assert _degrees(base[:, 0], data.base) < 3
    assert (state[:, 0] - data.state).abs().max() < 0.05
    assert error[:, 0].max() < 0.03
    assert (error.diff(dim=1) >= 0).all()


def test_hypotheses_that_are_kept_differ():
    rotations = rotation_group(60).elements.float()
    near = roma.rotvec_to_rotmat(torch.tensor([0.1, 0.0, 0.0]))
    base = torch.eye(4).repeat(1, 4, 1, 1)
    base[0, :, :3, :3] = torch.stack([rotations[0], near @ rotations[0], rotations[7], near @ rotations[7]])
    error = torch.tensor([[0.1, 0.2, 0.4, 0.3]])
    assert different(base, error, 2).tolist() == [[0, 3]]
    assert different(base, error, 4).tolist() == [[0, 3, 1, 2]]  # near ones again once no other is left
