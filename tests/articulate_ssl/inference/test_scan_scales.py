"""Scans are predicted as clouds of a set are: with all their points, where anything reads them."""

import numpy as np
import pytest
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.scan_scales import SCALE_STARTS, predict_scans


def _by_relief(estimator):
    estimator.two_ways.learnt.fill_(True)


def _by_a_network(estimator):
    estimator.two_ways.surface = torch.nn.Identity()


def _by_its_door(estimator):
    estimator.hinge_sides.learnt.fill_(True)


def _by_its_faces(estimator):
    estimator.part_frames.flat.fill_(True)


def _by_closed_doors(estimator):
    _by_its_faces(estimator)
    estimator.closed_views.views = torch.zeros(1, 8, 3, dtype=torch.int8)


@pytest.mark.parametrize("learnt", [None, _by_closed_doors, _by_relief, _by_a_network, _by_its_door, _by_its_faces])
def test_what_reads_all_points_gets_all_points_and_takes_proportions_by_these_alone_unless_doors_may_be_closed(
    learnt, monkeypatch
):
    estimator, plain, asked = tiny_module().eval().estimator, tiny_module().eval().estimator, []
    predict = PoseEstimator.predict_with_rivals

    def told(_self, points, num_points, _refine=None, dense=None, fits=True):
        asked.append((len(points), None if dense is None else dense.shape[1], fits))
        return predict(plain, points, num_points, False)

    if learnt is not None:
        learnt(estimator)
    monkeypatch.setattr(PoseEstimator, "predict_with_rivals", told)
    scan = np.random.default_rng(0).random((5 * POINTS, 3))
    predict_scans(estimator, [scan], POINTS, (0.3, 0.02))
    first = len(SCALE_STARTS), None, learnt in (None, _by_closed_doors)
    assert asked == ([first] if learnt is None else [first, (1, 5 * POINTS, True)])
