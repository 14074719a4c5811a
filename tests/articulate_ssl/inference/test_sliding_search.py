"""Chests are found in clouds of any orientation and proportion, by what a collection knows, without a network."""

import pytest
import roma
import torch
from articulated_objects import CHEST, Clouds, clouds
from torch.nn.functional import one_hot

from articulate_ssl.discovery.registration import chamfer_l1
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.part_network import PartNetwork
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.scan_scales import predict_scans
from articulate_ssl.inference.sliding_search import SlidingSearch
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.observation import Observation

CHAIN = KinematicChain(3, 0, (0, 0), (1, 2))
LIMITS = torch.tensor([[-0.2, 0.2], [-0.2, 0.2]])


def _chests(count: int, seed: int) -> Clouds:
    return clouds(CHEST, count=count, points=2048, resample=True, seed=seed)


def _shape(data: Clouds) -> ArticulatedShape:
    """With as many points of every part, part by part."""
    points = torch.cat([data.rest[data.part == part][:200] for part in range(3)])
    joints = Joints(CHAIN, data.axis, data.pivot, PRISMATIC, LIMITS)
    return ArticulatedShape(points, torch.arange(3).repeat_interleave(200), joints)


@pytest.fixture(scope="module")
def learnt():
    """A search that has learnt from eight clouds."""
    data = _chests(8, seed=0)
    search = SlidingSearch(3, 200)
    assert not search.learnt
    search.learn(_shape(data), LIMITS, data.points, data.base)
    return search


def test_unseen_chests_of_other_proportions_are_found(learnt):
    data = _chests(4, seed=1)
    proportion = torch.tensor([1.15, 0.85, 1.0])
    standing = transform_points(torch.linalg.inv(data.base), data.points) * proportion
    points = transform_points(data.base, standing)
    shape, base, state, margin, votes = learnt.search(CHAIN, points)
    assert votes is None  # no cloud has labels
    truth = data.base[:, None, :3, :3].expand(-1, 2, -1, -1)
    angle = roma.rotmat_geodesic_distance(base[..., :3, :3], truth).rad2deg()
    assert angle[:, 0].max() < 5 and angle[:, 1].min() > 80
    assert (margin > 0).all() and (margin < 1).all()
    assert (state[:, 0] - proportion[0] * data.state).abs().median() < 0.03
    posed = shape.posed(base.flatten(0, 1), state.flatten(0, 1)).unflatten(0, (4, 2))
    first, second = (chamfer_l1(points[:, :512], posed[:, turn]) for turn in (0, 1))
    assert (first < second).all()


def test_a_gallery_that_was_turned_over_turns_predictions_over(learnt):
    data = _chests(4, seed=2)
    over = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    other = SlidingSearch(3, 200)
    other.load_state_dict(learnt.state_dict())
    other.gallery = learnt.gallery @ over
    torch.testing.assert_close(other.turns(data.points)[0][:, 0], over @ learnt.turns(data.points)[0][:, 0])


class _Upright(SurfaceDecision):
    """Stands in for a network: an object looks right where the camera's z points along an axis of it."""

    def __init__(self, axis: int) -> None:
        super().__init__()
        self.axis = axis

    def looks_right(self, frames, dense):
        return 4 * frames[..., 2, self.axis]


def test_a_network_chooses_among_the_leading_turns_and_says_how_sure_it_is(learnt):
    data = _chests(3, seed=2)
    search = SlidingSearch(3, 200)
    search.load_state_dict(learnt.state_dict())
    leading, _ = search.leading_turns(data.points)
    search.surface = _Upright(axis=1)
    turn, margin = search.turns(data.points)
    said = leading.mT[..., 2, 1]
    best, index = said.max(dim=1)
    torch.testing.assert_close(turn[:, 0], leading[torch.arange(3), index])
    torch.testing.assert_close(margin, (2 * (best - said.topk(2).values[:, 1])).tanh())
    found = search.search(CHAIN, data.points).base[:, 0, :3, :3]
    other = learnt.search(CHAIN, data.points).base[:, 0, :3, :3]
    assert roma.rotmat_geodesic_distance(found, turn[:, 0].mT).max() < 0.15
    assert roma.rotmat_geodesic_distance(other, leading[:, 0].mT).max() < 0.1
    # It is kept with the weights.
    search.surface = SurfaceDecision(SurfaceSize(read=128, centers=64))
    again = SlidingSearch(3, 200)
    again.load_state_dict(search.state_dict())
    assert again.surface.size.read == 128
    again.load_state_dict(learnt.state_dict())
    assert again.surface is None


def test_clouds_do_not_interact_and_the_gallery_is_saved(learnt):
    data = _chests(2, seed=3)
    again = SlidingSearch(3, 200)
    again.load_state_dict(learnt.state_dict())
    assert again.learnt
    for together, alone in zip(
        learnt.search(CHAIN, data.points)[1:4],
        again.search(CHAIN, data.points[1:2])[1:4],
        strict=True,
    ):
        torch.testing.assert_close(together[1:2], alone, atol=1e-4, rtol=0)


def test_weights_from_before_there_was_a_search_have_none(learnt):
    old = {name: value for name, value in learnt.state_dict().items() if name == "points"}
    search = SlidingSearch(3, 200)
    search.load_state_dict({"points": old["points"]})
    assert not search.learnt


def test_clouds_of_few_points_will_do(learnt):
    data = _chests(8, seed=0)
    search = SlidingSearch(3, 200)
    search.learn(_shape(data), LIMITS, data.points[:, :300], data.base)
    assert search.learnt
    torch.testing.assert_close(search.turns(data.points)[0][:, 0], learnt.turns(data.points)[0][:, 0])


def _estimator(data: Clouds) -> PoseEstimator:
    """With a network that has learnt nothing."""
    options = NetworkOptions(
        group_order=12, dims=(8, 8, 8), num_neighbors=8, num_centers=(128, 64, 32), head_dim=8, shape_points=200
    )
    torch.manual_seed(0)
    network = ArticulatedNetwork(options, 3, PRISMATIC).eval()
    estimator = PoseEstimator(network, None, 1, Observation(), 0.05, InferenceOptions(refine=True))
    network.category.adopt(_shape(data))
    return estimator


def test_scans_of_any_scale_and_number_of_points_are_searched(learnt):
    data = _chests(2, seed=4)
    estimator = _estimator(data)
    estimator.sliding.load_state_dict(learnt.state_dict())
    radius = float((data.points - data.points.mean(dim=1, keepdim=True)).norm(dim=-1).mean())
    scans = [700 * data.points[0].numpy() + 5, data.points[1, :1500].numpy()]
    for estimate, base in zip(predict_scans(estimator, scans, 256, (radius, 0.01)), data.base, strict=True):
        found = estimate.prediction.base_pose[0, :3, :3]
        assert roma.rotmat_geodesic_distance(found, base[:3, :3]).rad2deg() < 5
        assert estimate.rival is not None


def test_the_search_competes_with_the_network(learnt):
    data = _chests(2, seed=4)
    estimator = _estimator(data)
    points = data.points[:, :256]
    without = estimator.predict(points, 256, dense=data.points)
    estimator.sliding.load_state_dict(learnt.state_dict())
    with torch.inference_mode():  # as a trainer tests
        found = estimator.predict(points.clone(), 256, dense=data.points.clone())
    alone = estimator.search(points, data.points)
    truth = data.base[:, :3, :3]
    for prediction in (found, alone):
        assert roma.rotmat_geodesic_distance(prediction.base_pose[:, :3, :3], truth).rad2deg().max() < 5
        # Parts where the shape has them, at the cloud's own proportions.
        whole = prediction.part_shape + prediction.assembly[:, :, None]
        pose = se3(prediction.base_pose[:, :3, :3], prediction.base_pose[:, :3, 3])
        body = transform_points(pose, whole[:, 0])
        assert torch.cdist(body, points).amin(dim=2).mean() < 0.05
    assert (found.margin < 1).all() and (found.margin > 0).all()
    unread = estimator.predict(points, 256)
    torch.testing.assert_close(unread.reconstruction_error, without.reconstruction_error)


@pytest.fixture(scope="module")
def labelled(learnt):
    """A search that has learnt from eight clouds whose points have parts, too."""
    data = _chests(8, seed=0)
    boxes, _, _ = unit_boxes(transform_points(torch.linalg.inv(data.base), data.points))
    search = SlidingSearch(3, 200)
    search.learn(_shape(data), LIMITS, data.points, data.base, LabelledClouds(boxes, data.part.expand(8, -1)))
    return search


def test_labelled_clouds_say_parts_and_where_they_are(labelled):
    data = _chests(4, seed=1)
    _, base, state, _, votes = labelled.search(CHAIN, data.points)
    assert torch.equal(votes.points, data.points) and votes.share.shape == (4, 2048, 3)
    assert (votes.share.argmax(dim=-1) == data.part).float().mean() > 0.85
    assert roma.rotmat_geodesic_distance(base[:, 0, :3, :3], data.base[:, :3, :3]).rad2deg().max() < 5
    assert (state[:, 0] - data.state).abs().median() < 0.02


def test_limits_are_learnt_from_clouds_whose_points_have_parts(labelled):
    search = SlidingSearch(3, 200)
    search.load_state_dict(labelled.state_dict())
    search.limits.copy_(LIMITS / 10)  # no limits for what is read
    data = clouds(CHEST, count=64, points=600, seed=5, rotate=False)
    found = search.learn_limits(CHAIN, data.points, data.part.expand(64, -1)[:, :512])
    assert torch.equal(found, search.limits)
    torch.testing.assert_close(found, torch.tensor([[-0.175, 0.175]] * 2), atol=0.06, rtol=0)
    _, _, state, _, _ = search.search(CHAIN, _chests(2, seed=6).points)
    assert float(state.abs().max()) > 0.03


def test_labels_are_saved_and_decide_which_part_points_are_of(labelled):
    data = _chests(2, seed=4)
    swapped = SlidingSearch(3, 200)
    # Files of weights give all numbers as float32.
    saved = {
        name: value.float() if value.is_floating_point() else value for name, value in labelled.state_dict().items()
    }
    swapped.load_state_dict(saved)
    assert swapped.labelled.dtype == torch.int8 and torch.equal(swapped.part, labelled.part)
    swapped.part = torch.tensor([0, 2, 1], dtype=torch.uint8)[swapped.part.long()]
    estimator, points = _estimator(data), data.points[:, :256]
    parts = []
    for search in (labelled, swapped):
        estimator.sliding.load_state_dict(search.state_dict())
        with torch.inference_mode():  # as a trainer tests
            parts.append(estimator.predict(points.clone(), 256, dense=data.points.clone()))
    for one, name in zip(parts, ([0, 1, 2], [0, 2, 1]), strict=True):
        for own, true in ((one.part_id, data.part[:256]), (one.dense_part_id, data.part)):
            assert own.shape[1] == len(true) and (torch.tensor(name)[own] == true).float().mean() > 0.85


def test_votes_follow_faces_and_points_have_those_of_the_nearest(labelled, monkeypatch):
    data = _chests(2, seed=6)
    noise = torch.rand(4, 2048, 3, generator=torch.Generator().manual_seed(0))
    clean = one_hot(data.part, 3).float()

    def votes(self, boxes, num_parts, points):
        return (0.6 * clean + noise).clamp(max=1.2)[:, : points.shape[1]] / 3

    monkeypatch.setattr(LabelledClouds, "votes", votes)
    said = (votes(None, None, 3, data.points).argmax(dim=-1) == data.part).float().mean()
    nearly = data.points[:, 5:105] + 1e-5
    found = labelled.search(CHAIN, data.points).votes.at(nearly).argmax(dim=-1)
    assert (found == data.part[5:105]).float().mean() > said + 0.05


def test_a_network_says_parts_in_place_of_labelled_clouds(labelled, monkeypatch):
    """Of either turn; and it is saved."""
    data, taught = _chests(2, seed=8), SlidingSearch(3, 200)
    taught.load_state_dict(labelled.state_dict())
    assert taught.parts is None
    taught.parts = PartNetwork(3).eval().requires_grad_(False)
    again = SlidingSearch(3, 200)
    again.load_state_dict(taught.state_dict())
    assert again.parts is not None and not any(p.requires_grad for p in again.parameters())
    asked = []

    def probability(clouds, turn):
        asked.append(turn)
        likelier = one_hot(data.part, 3).float()
        return torch.stack([likelier, likelier.roll(1, dims=-1)], dim=0).expand(len(clouds), -1, -1, -1)

    monkeypatch.setattr(again.parts, "probability", probability)
    monkeypatch.setattr(LabelledClouds, "votes", None)  # nobody asks
    found = again.search(CHAIN, data.points)
    assert asked[0].shape == (2, 2, 3, 3)
    assert (found.votes.share.argmax(dim=-1) == data.part).float().mean() > 0.97
    assert (found.state[:, 0] - data.state).abs().median() < 0.02


def test_an_object_is_understood_and_may_be_kept(labelled):
    data = _chests(8, seed=7)
    understood, turn = labelled.understood(CHAIN, data.points)
    truth = data.base[:, :3, :3].mT
    assert roma.rotmat_geodesic_distance(turn, truth).rad2deg().max() < 5
    assert understood.points.shape == (8, 2048, 3) and (understood.part == data.part).float().mean() > 0.97
    standing, _, _ = unit_boxes(transform_points(torch.linalg.inv(data.base), data.points))
    assert (understood.points - standing).abs().max() < 0.2
