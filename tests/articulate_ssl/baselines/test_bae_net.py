"""BAE-Net: it learns what is inside, and a part is the branch of largest value."""

from __future__ import annotations

import pytest
import torch
from occupied import write_occupied_set
from torch.testing import assert_close

from articulate_ssl.baselines import method_class
from articulate_ssl.baselines.bae_net import BAENet
from articulate_ssl.baselines.method import OCCUPANCY, Problem
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from datamodules.articulated_data_module import ArticulatedDataModule

PROBLEM = Problem(num_parts=3, joint_type=REVOLUTE, state_range=1.3, num_points=32)


@pytest.fixture
def data(tmp_path):
    folder = write_occupied_set(tmp_path)
    return ArticulatedDataModule("laptop", str(folder.parents[1]), num_points=32, batch_size=4, occupancy=True)


def test_it_is_a_row_of_the_table():
    assert method_class("bae_net") is BAENet
    assert BAENet.given == (OCCUPANCY,) and not BAENet.labelled_spaces, "it reads no labels"


def test_the_reconstruction_loss_falls(data):
    torch.manual_seed(0)
    method = BAENet(PROBLEM)
    optimizer = method.configure_optimizers()["optimizer"]
    data.setup("fit")
    batch, losses = next(iter(data.train_dataloader())), []
    for step in range(40):
        loss = method.training_step(batch, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]
    inside = method.decoder(method.encoder(batch["points"]), batch["occupancy_points"]).amax(-1)
    assert ((inside > 0.5) == (batch["occupancy"] > 0.5)).float().mean() > 0.9


def test_a_point_belongs_to_the_largest_branch():
    torch.manual_seed(0)
    method, points = BAENet(PROBLEM), torch.randn(2, 32, 3)
    prediction = method.predict({"points": points})
    value = method.decoder(method.encoder(points), points)
    assert torch.equal(prediction.part_id, value.argmax(-1))
    assert_close(prediction.part_probability.sum(-1), torch.ones(2, 32))
    assert value.min() >= 0 and value.max() <= 1


def test_branches_that_say_nothing_still_give_probabilities():
    method = BAENet(PROBLEM)
    torch.nn.init.constant_(method.decoder.branch.bias, -1e4)
    prediction = method.predict({"points": torch.randn(1, 32, 3)})
    assert_close(prediction.part_probability.sum(-1), torch.ones(1, 32))


def test_metrics_are_calibrated_on_its_own_slots(data):
    method = BAENet(Problem(2, REVOLUTE, 1.3, 32))
    labels = next(iter(data.calibration_dataloader()))
    prediction = method.predict({"points": labels["points"]})
    metrics = ArticulatedPoseMetrics(calibrate(prediction, labels))
    metrics.update(prediction, labels)
    result = metrics.compute()
    assert result["samples"] == 4 and 0 <= result["seg_miou"]["mean"] <= 1
