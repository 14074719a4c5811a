import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch

from articulate_ssl.inference.articulation import articulate, canonical_object, part_motion, posed_parts, to_input_frame
from articulate_ssl.inference.prediction import Prediction

OBJECTS = [synthetic.laptop, synthetic.drawer, synthetic.arm]


def batch(*predictions: Prediction) -> Prediction:
    return Prediction(**{n: torch.cat([getattr(p, n) for p in predictions]) for n in Prediction.__dataclass_fields__})


@pytest.mark.parametrize("make", OBJECTS)
def test_articulating_to_the_predicted_state_is_the_reconstruction(make):
    prediction, _ = make()
    moved = articulate(prediction, prediction.joint_state)
    torch.testing.assert_close(moved, posed_parts(prediction), atol=1e-6, rtol=0)


@pytest.mark.parametrize("make", OBJECTS)
def test_at_state_zero_the_object_is_canonical(make):
    prediction, _ = make()
    moved = articulate(prediction, torch.zeros_like(prediction.joint_state))
    pose = prediction.base_pose[0]
    expected = canonical_object(prediction) @ pose[:3, :3].T + pose[:3, 3]
    torch.testing.assert_close(moved, expected, atol=1e-6, rtol=0)


def test_points_on_the_joint_line_stay_and_the_lid_turns():
    prediction, _ = synthetic.laptop()
    motion = part_motion(prediction, torch.tensor([np.pi / 2]))[0]
    pivot = torch.cat([prediction.canonical_pivot[0, 0], torch.ones(1)])
    torch.testing.assert_close(motion[1] @ pivot, pivot)
    torch.testing.assert_close(motion[0], torch.eye(4))
    front_edge = motion[1] @ torch.tensor([0.0, -0.275, 0.02, 1.0])
    assert front_edge[2] > 0.5  # opens upwards


def test_batches_may_mix_trees_and_joint_types():
    laptop, drawer = synthetic.laptop()[0], synthetic.laptop(seed=3)[0]
    sliding = Prediction(**{**vars(drawer), "joint_type": torch.ones(1, 1, dtype=torch.int64)})
    states = torch.tensor([[0.4], [0.1]])
    both = part_motion(batch(laptop, sliding), states)
    torch.testing.assert_close(both[0], part_motion(laptop, states[:1])[0])
    torch.testing.assert_close(both[1], part_motion(sliding, states[1:])[0])


@pytest.mark.parametrize("make", OBJECTS)
def test_input_frame_undoes_the_normalisation(make):
    prediction, _ = make()
    before = {n: getattr(prediction, n).clone() for n in Prediction.__dataclass_fields__}
    center, scale = torch.tensor([100.0, -20.0, 3.0], dtype=torch.float64), 250.0
    metric = to_input_frame(prediction, center, scale)
    expected = posed_parts(prediction).double() * scale + center
    torch.testing.assert_close(posed_parts(metric), expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(articulate(metric, metric.joint_state), expected, atol=1e-3, rtol=0)
    rotation = metric.part_pose[0, :, :3, :3]
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(rotation), dtype=torch.float64))
    for name, value in before.items():
        assert torch.equal(getattr(prediction, name), value), f"to_input_frame changed {name} of its argument"


def test_input_frame_twice_does_not_touch_its_argument():
    metric = to_input_frame(synthetic.drawer()[0], torch.zeros(3, dtype=torch.float64), 2.0)
    pose = metric.part_pose.clone()
    to_input_frame(metric, torch.ones(3, dtype=torch.float64), 2.0)
    assert torch.equal(metric.part_pose, pose)
