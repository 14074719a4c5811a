"""What the segmentation methods share: encoder, neutral prediction, and parts of primitives by labelled shapes."""

from __future__ import annotations

import pytest
import torch
from occupied import POINTS, write_occupied_set
from torch.testing import assert_close

from articulate_ssl.baselines.implicit import (
    CloudEncoder,
    PrimitiveMethod,
    cloud_distances,
    draw_samples,
    segmentation,
)
from articulate_ssl.baselines.method import Effort, Problem
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from datamodules.articulated_data_module import ArticulatedDataModule

PROBLEM = Problem(num_parts=2, joint_type=REVOLUTE, state_range=1.3, num_points=32)


class Slabs(PrimitiveMethod):
    """Primitives that are slabs across x, in order of their x."""

    title = "Slabs"
    effort = Effort(steps=1, batch_size=4, learning_rate=1e-3)

    def primitive_of(self, points):
        return torch.bucketize(points[..., 0].contiguous(), torch.linspace(-0.5, 0.5, self.num_primitives - 1))


def test_a_code_does_not_depend_on_the_order_of_points():
    torch.manual_seed(0)
    encoder, points = CloudEncoder(16), torch.randn(3, 40, 3)
    assert_close(encoder(points), encoder(points[:, torch.randperm(40)]))
    assert (encoder(points)[0] - encoder(points)[1]).abs().max() > 1e-3


def test_samples_are_the_same_of_every_cloud_and_no_more_than_asked():
    points = torch.arange(30.0).view(1, 10, 3).repeat(2, 1, 1)
    chosen, occupancy = draw_samples({"occupancy_points": points, "occupancy": points[..., 0]}, 4)
    assert chosen.shape == (2, 4, 3) and torch.equal(chosen[0], chosen[1])
    assert torch.equal(chosen[..., 0], occupancy)
    with pytest.raises(ValueError, match="--occupancy"):
        draw_samples({"points": points})


def test_a_cloud_is_nearest_to_itself_turned_least():
    torch.manual_seed(0)
    clouds = torch.randn(4, 80, 3)
    shifted = clouds + torch.tensor([0.01, 0.0, 0.0])
    distance = cloud_distances(shifted, clouds)
    assert distance.argmin(1).tolist() == [0, 1, 2, 3]
    assert_close(cloud_distances(clouds, clouds).diagonal(), torch.zeros(4), atol=1e-4, rtol=0)


@pytest.fixture
def data(tmp_path):
    folder = write_occupied_set(tmp_path)
    return ArticulatedDataModule("laptop", str(folder.parents[1]), num_points=32, batch_size=4, occupancy=True)


def test_metrics_accept_a_prediction_that_only_segments(data):
    labels = next(iter(data.calibration_dataloader()))
    part = labels["dense_part_id"][:, :32]
    prediction = segmentation(labels["points"], torch.nn.functional.one_hot(1 - part, 2).float())
    metrics = ArticulatedPoseMetrics(calibrate(prediction, labels))
    metrics.update(prediction, labels)
    assert (
        metrics.compute()["seg_miou"]["mean"] > 0.5
    )  # slots are matched to parts; the rest is the 32 points' coarseness


def test_a_primitive_is_the_part_that_it_is_in_the_most_similar_labelled_cloud():
    method = Slabs(PROBLEM, 4)
    torch.manual_seed(0)
    long_first = torch.rand(32, 3) * torch.tensor([1.0, 0.1, 0.1]) - 0.5
    tall = torch.rand(32, 3) * torch.tensor([1.0, 0.1, 3.0]) - 0.5
    method.gallery_points = torch.stack([long_first, tall])
    # In the first cloud low x is part 0; in the second it is part 1.
    method.gallery_part = torch.stack([(long_first[:, 0] > 0).long(), (tall[:, 0] <= 0).long()])
    method.on_train_end()
    assert method.gallery_votes.sum((1, 2)).tolist() == [32, 32]
    part = method.predict({"points": torch.stack([tall + 0.01, long_first + 0.01])}).part_id
    assert (part[0] == (tall[:, 0] <= 0).long()).float().mean() > 0.8
    assert (part[1] == (long_first[:, 0] > 0).long()).float().mean() > 0.8


def test_a_primitive_that_the_similar_cloud_does_not_use_is_what_it_is_elsewhere():
    method = Slabs(PROBLEM, 4)
    torch.manual_seed(0)
    left = torch.rand(32, 3) * torch.tensor([0.4, 0.1, 0.1]) - 0.5
    right = left + torch.tensor([0.9, 5.0, 0.0])
    method.gallery_points = torch.stack([left, right])
    method.gallery_part = torch.stack([torch.zeros(32), torch.ones(32)]).long()
    method.on_train_end()
    points = left.clone()
    points[0, 0] = 0.7
    part = method.predict({"points": points[None]}).part_id[0]
    assert part[0] == 1 and (part[1:] == 0).all()


def test_the_gallery_is_of_training_clouds_with_the_part_of_each_point(data):
    method = Slabs(PROBLEM, 4)
    method.prepare(data, 0)
    method.on_train_end()
    assert method.gallery_points.shape == (12, 32, 3)
    assert method.gallery_part.unique().tolist() == [0, 1]
    batch = next(iter(data.discovery_dataloader(12)))
    assert torch.equal(method.gallery_part[:4], batch["dense_part_id"][:, :32])
    assert "gallery_votes" in method.state_dict(), "a restored method can predict"


def test_what_is_not_trained_says_so():
    with pytest.raises(RuntimeError, match="Slabs is not trained"):
        Slabs(PROBLEM, 4).predict({"points": torch.zeros(1, 32, 3)})


def test_batches_hold_the_samples(data):
    data.setup("fit")
    points, occupancy = draw_samples(next(iter(data.train_dataloader())))
    assert points.shape == (4, POINTS, 3) and occupancy.mean() == 0.5
