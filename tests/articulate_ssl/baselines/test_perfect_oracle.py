import pytest
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.perfect_oracle import part_points, perfect_oracle
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.functional import nearest_index
from datamodules.articulated_dataset import ArticulatedDataset


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
@pytest.mark.parametrize(("view", "protocol"), [("complete", None), ("partial", "honest")])
def test_ground_truth_of_a_data_set_scores_without_error(tmp_path, joint_type, view, protocol):
    folder = write_synthetic_set(tmp_path, view=view, protocol=protocol, joint_type=joint_type)
    train, test = (ArticulatedDataset(folder, split, num_points=128) for split in ("train", "test"))
    labels, test_labels = (s.__getitems__(list(range(len(s)))) for s in (train, test))
    metrics = ArticulatedPoseMetrics(calibrate(perfect_oracle(labels), labels), replicates=20)
    metrics.update(perfect_oracle(test_labels), test_labels)
    result = metrics.compute()
    assert result["seg_miou"]["mean"] == 1.0
    for name in ("r_err_deg", "t_err", "axis_err_deg", "state_err", "chamfer_l1"):
        assert result[name]["mean"] < 1e-4
    assert (result["pivot_err"]["mean"] or 0.0) < 1e-5


def test_canonical_shapes_are_at_rest_and_assemble_to_the_object(synthetic_set):
    labels = ArticulatedDataset(synthetic_set, "test", num_points=128).__getitems__([0, 5])
    prediction = perfect_oracle(labels)
    posed = transform_points(prediction.part_pose, prediction.part_shape).flatten(1, 2)
    assert nearest_index(labels["points"], posed)[0].max() < 1e-5
    assembled = prediction.part_shape + prediction.assembly[:, :, None]
    base = transform_points(prediction.base_pose, assembled[:, 0])
    torch.testing.assert_close(base, posed[:, :128], atol=1e-5, rtol=0)


def test_points_of_a_part_are_repeated_or_stand_for_nothing():
    points, part_id = torch.eye(3), torch.tensor([0, 1, 1])
    fallback = torch.tensor([9.0, 9, 9])
    assert torch.equal(part_points(points, part_id, 1, 5, fallback), points[[1, 2, 1, 2, 1]])
    assert torch.equal(part_points(points, part_id, 2, 2, fallback), fallback.expand(2, 3))
