"""An object's axes are the edges of its box, however it is turned."""

import pytest
import roma
import torch
from articulated_objects import DRAWER, LAPTOP, OVEN, clouds, true_shape

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.object_axes import object_axes


@pytest.mark.parametrize("design", [LAPTOP, OVEN, DRAWER], ids=["laptop", "oven", "drawer"])
def test_they_turn_with_the_object_and_the_first_is_its_joints(design):
    shape = true_shape(design, clouds(design, points=600))
    turn = roma.rotvec_to_rotmat(torch.tensor([0.3, 0.9, -1.4]))
    axes = object_axes(shape.in_frame(se3(turn, torch.tensor([1.0, -2.0, 0.5]))))
    torch.testing.assert_close(axes[:, 0], turn @ shape.joints.axis[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(axes.T @ axes, torch.eye(3), atol=1e-5, rtol=0)
    assert (turn.T @ axes).abs().amax(dim=0).min() > 0.999
