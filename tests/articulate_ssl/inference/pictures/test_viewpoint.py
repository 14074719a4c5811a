import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.pictures.viewpoint import viewing_rotation
from articulate_ssl.inference.prediction import Prediction

RANGE = torch.tensor([[0.16, 1.73]])
SLIDE = torch.tensor([[0.0, 0.3]]).repeat(3, 1)


@pytest.mark.parametrize("seed", range(4))
def test_the_view_follows_the_object_not_the_canonical_frame(seed):
    prediction, _ = synthetic.laptop()
    view = viewing_rotation(prediction, RANGE)
    turn = synthetic.random_rotation(seed + 20)
    turned = Prediction(
        **{
            **vars(prediction),
            "part_shape": prediction.part_shape @ turn.T,
            "assembly": prediction.assembly @ turn.T,
            "canonical_axis": prediction.canonical_axis @ turn.T,
            "canonical_pivot": prediction.canonical_pivot @ turn.T,
            "base_pose": prediction.base_pose @ se3(turn.T, torch.zeros(3)),
        }
    )
    np.testing.assert_allclose(viewing_rotation(turned, RANGE) @ turn.numpy(), view, atol=1e-3)


@pytest.mark.parametrize(("make", "limits"), [(synthetic.laptop, RANGE), (synthetic.drawer, SLIDE)])
def test_the_view_is_a_rotation_that_shows_the_object_upright(make, limits):
    view = viewing_rotation(make()[0], limits)
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(view) == pytest.approx(1)
    assert abs(view[1, 2]) > 0.85  # the canonical z of both objects is vertical in the picture


def test_a_lid_is_above_its_base_and_hinged_behind():
    prediction, _ = synthetic.laptop()
    view = viewing_rotation(prediction, RANGE)
    assert view[1] @ [0, 0, 1] > 0.85  # the lid opens towards canonical +z
    assert view[2] @ [0, 1, 0] < -0.5  # the hinge is at canonical +y, away from the viewer


def test_a_drawer_comes_towards_the_viewer():
    assert viewing_rotation(synthetic.drawer()[0], SLIDE)[2] @ [0, -1, 0] > 0.5


def test_a_door_in_a_thick_body_opens_upwards_though_the_body_is_thinner_elsewhere():
    boxes = [((0.5, 0.35, 0.6), (0, 0, 0)), ((0.5, 0.35, 0.02), (0, 0, 0.31))]
    joints = [(REVOLUTE, 0, 1, (0.0, 1, 0), (0.25, 0, 0.31))]
    prediction, _ = synthetic.chain_of_boxes(boxes, joints, [1.5])
    assert viewing_rotation(prediction, torch.tensor([[0.0, 3.0]]))[1] @ [0, 0, 1] > 0.85
