import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.pictures.viewpoint import (
    MEAN_CAMERA_ELEVATION,
    OWN_DIRECTION,
    level_frame,
    viewing_rotation,
)
from articulate_ssl.inference.prediction import Prediction

RANGE = torch.tensor([[0.16, 1.73]])
SLIDE = torch.tensor([[0.0, 0.3]]).repeat(3, 1)


def in_other_canonical_frame(prediction: Prediction, turn: torch.Tensor) -> Prediction:
    return Prediction(
        **{
            **vars(prediction),
            "part_shape": prediction.part_shape @ turn.T,
            "assembly": prediction.assembly @ turn.T,
            "canonical_axis": prediction.canonical_axis @ turn.T,
            "canonical_pivot": prediction.canonical_pivot @ turn.T,
            "base_pose": prediction.base_pose @ se3(turn.T, torch.zeros(3)),
        }
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_view_follows_the_object_not_the_canonical_frame(seed):
    prediction, _ = synthetic.laptop()
    view = viewing_rotation(prediction, RANGE)
    turn = synthetic.random_rotation(seed + 20)
    turned = in_other_canonical_frame(prediction, turn)
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


@pytest.mark.parametrize("elevation", [25.0, 35.0, 45.0])
@pytest.mark.parametrize(("make", "limits"), [(synthetic.laptop, RANGE), (synthetic.drawer, SLIDE)])
def test_with_an_upright_camera_up_is_the_objects_own_and_front_is_to_the_camera(make, limits, elevation):
    """Canonical object space turned as the mean camera is: x right, y down, z forward, looking down on the object."""
    prediction, _ = make()
    e = np.radians(elevation)
    # The object's right, back and up (x, y, z of the synthetic objects), column by column, as this camera sees them.
    camera = np.array([[1, 0, 0], [0, -np.sin(e), -np.cos(e)], [0, np.cos(e), -np.sin(e)]]).astype(np.float32)
    turned = in_other_canonical_frame(prediction, torch.from_numpy(camera))
    right, up, front = level_frame(turned, limits, upright=True)
    np.testing.assert_allclose(up, camera @ [0, 0, 1], atol=0.15)
    np.testing.assert_allclose(front, camera @ [0, -1, 0], atol=0.15)
    np.testing.assert_allclose(right, camera @ [1, 0, 0], atol=0.15)


def test_with_an_upright_camera_an_object_without_a_vertical_stands_as_the_mean_camera_sees_it():
    boxes = [((0.5, 0.5, 0.5), (0, 0, 0))]
    prediction, _ = synthetic.chain_of_boxes(boxes, [], [])
    tilt = torch.linalg.matrix_exp(torch.tensor([[0, 0, 0.6], [0, 0, 0.4], [-0.6, -0.4, 0.0]]))
    up = level_frame(in_other_canonical_frame(prediction, tilt), torch.empty(0, 2), upright=True)[1]
    assert up @ [0, -np.cos(MEAN_CAMERA_ELEVATION), -np.sin(MEAN_CAMERA_ELEVATION)] > np.cos(OWN_DIRECTION) - 1e-6


def test_a_drawer_comes_towards_the_viewer():
    assert viewing_rotation(synthetic.drawer()[0], SLIDE)[2] @ [0, -1, 0] > 0.5


def test_a_door_in_a_thick_body_opens_upwards_though_the_body_is_thinner_elsewhere():
    boxes = [((0.5, 0.35, 0.6), (0, 0, 0)), ((0.5, 0.35, 0.02), (0, 0, 0.31))]
    joints = [(REVOLUTE, 0, 1, (0.0, 1, 0), (0.25, 0, 0.31))]
    prediction, _ = synthetic.chain_of_boxes(boxes, joints, [1.5])
    assert viewing_rotation(prediction, torch.tensor([[0.0, 3.0]]))[1] @ [0, 0, 1] > 0.85
