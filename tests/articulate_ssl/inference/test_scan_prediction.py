import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import CENTER, OBJECTS, SCALE, result_of

from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.checkpoint_file import CheckpointError


@pytest.mark.parametrize("make", OBJECTS)
def test_the_prediction_is_in_the_frame_of_the_scan(make):
    result = result_of(make)
    expected = posed_parts(make()[0]).double() * SCALE + torch.tensor(CENTER)
    torch.testing.assert_close(posed_parts(result.prediction), expected, atol=1e-6, rtol=0)


def test_every_point_of_the_scan_has_the_part_of_the_nearest_point_that_the_network_saw():
    prediction, points = synthetic.laptop()
    cloud = np.repeat(points.numpy() * SCALE + CENTER, 3, axis=0)
    result = result_of(synthetic.laptop, cloud=cloud)
    np.testing.assert_array_equal(result.part_id, np.repeat(prediction.part_id[0].numpy(), 3))


def test_a_diverged_prediction_is_refused():
    prediction, _ = synthetic.laptop()
    prediction.part_pose[0, 1, 0, 0] = float("nan")
    with pytest.raises(CheckpointError, match=r"thing.ckpt: predicts NaN.*part_pose.*train again"):
        result_of(synthetic.laptop, prediction=prediction)


def test_a_batch_is_refused():
    with pytest.raises(ValueError, match="batch of 2"):
        result_of(synthetic.laptop, prediction=synthetic.laptop()[0][torch.tensor([0, 0])])
