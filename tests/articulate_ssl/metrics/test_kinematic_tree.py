import itertools
from dataclasses import replace

import pytest
import torch
from articulated_world import CHAIN, STAR, articulated_labels, disguise

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics import calibrate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.kinematic_tree import root_correct, tree_correct

TREES_OF_THREE = ([(0, 1), (0, 2)], [(0, 1), (1, 2)], [(0, 2), (2, 1)])


def with_edges(prediction: Prediction, edges: list[tuple[int, int]], clouds: slice = slice(None)) -> Prediction:
    """Edges (parent, child), as slots, in some clouds."""
    parent, child = prediction.joint_parent.clone(), prediction.joint_child.clone()
    parent[clouds], child[clouds] = torch.tensor(edges).T
    return replace(prediction, joint_parent=parent, joint_child=child)


@pytest.mark.parametrize("num_parts", [3, 4])
@pytest.mark.parametrize("tree", [CHAIN, STAR])
def test_the_true_tree_counts_whatever_slots_and_joints_are_called(num_parts, tree):
    """Disguises also call every second joint's child its parent, which is no error of the undirected tree."""
    labels = articulated_labels(num_parts=num_parts, tree=tree)
    for seed in range(4):
        prediction, _ = disguise(perfect_oracle(labels), seed)
        assert tree_correct(prediction, calibrate(prediction, labels)).tolist() == [1.0] * 24


def test_every_other_tree_is_wrong():
    labels = articulated_labels(num_parts=3, tree=STAR)
    truth = perfect_oracle(labels)
    calibration = calibrate(truth, labels)
    correct = [tree_correct(with_edges(truth, edges), calibration).mean().item() for edges in TREES_OF_THREE]
    # A constant tree is right always or never; one drawn at random is right once in three, the number of trees.
    assert correct == [1.0, 0.0, 0.0]


def test_what_is_no_tree_is_wrong():
    labels = articulated_labels(num_parts=3, tree=STAR)
    truth = perfect_oracle(labels)
    calibration = calibrate(truth, labels)
    for edges in ([(0, 1), (0, 1)], [(0, 1), (1, 0)], [(0, 1), (2, 2)]):
        assert tree_correct(with_edges(truth, edges), calibration).tolist() == [0.0] * 24


@pytest.mark.parametrize("num_parts", [2, 3, 4])
def test_the_root_is_the_part_that_is_no_child(num_parts):
    labels = articulated_labels(num_parts=num_parts, tree=STAR)
    truth = perfect_oracle(labels)
    calibration = calibrate(truth, labels)
    assert root_correct(truth, calibration).tolist() == [1.0] * 24
    for root in range(1, num_parts):
        edges = [(root, k) for k in range(num_parts) if k != root]
        assert root_correct(with_edges(truth, edges), calibration).tolist() == [0.0] * 24


def test_the_root_is_mapped_through_the_slots():
    labels = articulated_labels(num_parts=3, tree=STAR)
    moved = 0
    for seed in range(6):
        prediction, slot_of_part = disguise(perfect_oracle(labels), seed)
        root = slot_of_part[0].item()
        prediction = with_edges(prediction, [(root, k) for k in range(3) if k != root])
        assert root_correct(prediction, calibrate(prediction, labels)).tolist() == [1.0] * 24
        moved += root != 0
    assert moved


def test_two_roots_are_none():
    labels = articulated_labels(num_parts=3, tree=STAR)
    truth = perfect_oracle(labels)
    calibration = calibrate(truth, labels)
    assert root_correct(with_edges(truth, [(0, 1), (2, 1)]), calibration).tolist() == [0.0] * 24
    assert tree_correct(with_edges(truth, [(1, 0), (2, 0)]), calibration).tolist() == [1.0] * 24


def test_shares_per_cloud_and_null_where_they_say_nothing():
    for num_parts, wrong_tree in itertools.product((2, 3), (False, True)):
        labels = articulated_labels(num_parts=num_parts, tree=STAR)
        truth = perfect_oracle(labels)
        metrics = ArticulatedPoseMetrics(calibrate(truth, labels), replicates=20)
        edges = [(1, 0)] if num_parts == 2 else [(1, 0), (1, 2)]
        metrics.update(with_edges(truth, edges, slice(0, 6)) if wrong_tree else truth, labels)
        result = metrics.compute()
        assert result["root_accuracy"]["mean"] == (0.75 if wrong_tree else 1.0)
        expected = None if num_parts == 2 else 0.75 if wrong_tree else 1.0
        assert result["tree_accuracy"]["mean"] == expected


def test_a_method_without_joints_has_neither():
    labels = articulated_labels(num_parts=3)
    truth = perfect_oracle(labels)
    names = [n for n in vars(truth) if n.startswith(("joint_", "canonical_"))]
    jointless = replace(truth, **{n: getattr(truth, n)[:, :0] for n in names})
    calibration = calibrate(truth, labels)
    assert tree_correct(jointless, calibration).isnan().all()
    assert root_correct(jointless, calibration).isnan().all()
