"""Which way round objects are in views is as in the simulated views most like them, whatever a network says."""

import math
from dataclasses import fields

import pytest
import roma
import torch
from articulated_objects import OVEN, Clouds, clouds

from articulate_ssl.discovery.manhattan_frame import CAP
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference import other_views, view_search
from articulate_ssl.inference.contest import CLEARLY
from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.observation import Observation

RANGE = OrientationRange(100.0)
CHAIN = KinematicChain(2, 0, (0,), (1,))
OVER = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))


def _views(count: int, seed: int) -> Clouds:
    """Turned within the range; whole objects stand for views of them."""
    data = clouds(OVEN, count=count, points=512, resample=True, seed=seed)
    turn = RANGE.draw(count, torch.Generator().manual_seed(seed)) @ data.base[:, :3, :3].mT
    turn = se3(turn, turn.new_zeros(count, 3))
    return data._replace(points=transform_points(turn, data.points), base=turn @ data.base)


def _learnt(data: Clouds) -> ViewSearch:
    search = ViewSearch(2)
    assert not search.learnt
    search.learn(data.points, data.base, data.state, data.part.expand(len(data.points), -1)[:, : data.points.shape[1]])
    return search


@pytest.fixture(scope="module")
def learnt():
    """A search that has learnt from many views."""
    return _learnt(_views(300, seed=0))


def _degrees(a, b):
    return roma.rotmat_geodesic_distance(a, b).rad2deg()


def test_unseen_views_are_found_and_rivals_are_turned_another_way(learnt):
    data = _views(6, seed=1)
    base, state, margin, votes = learnt.search(data.points)
    assert base.shape == (6, 2, 4, 4) and state.shape == (6, 2, 1) and margin.shape == (6,)
    assert _degrees(base[:, 0, :3, :3], data.base[:, :3, :3]).max() < 20
    assert (state[:, 0] - data.state).abs().max() < 0.6
    back = transform_points(torch.linalg.inv(base[:, 0]), data.points)
    truth = transform_points(torch.linalg.inv(data.base), data.points)
    assert (back - truth).norm(dim=-1).mean() < 0.1
    torch.testing.assert_close(votes.share.sum(dim=-1), torch.ones(6, 512))
    assert (votes.share.argmax(dim=-1) == data.part).float().mean() > 0.95
    unsure = margin < 1
    apart = _degrees(base[:, 0, :3, :3], base[:, 1, :3, :3])
    assert (apart[unsure] > 30).all() and (apart[~unsure] < 1e-2).all()


def test_where_turns_are_known_only_views_turned_so_are_asked(learnt):
    data = _views(4, seed=6)
    truth = data.base[:, :3, :3]
    right, over = (learnt.search(data.points, turn) for turn in (truth, truth @ OVER))
    assert _degrees(right.base[:, 0, :3, :3], truth).max() < 20
    assert _degrees(over.base[:, 0, :3, :3], truth).min() > 90
    rows = torch.tensor([1, 3])
    mixed = right.with_rows(rows, learnt.search(data.points[rows], truth[rows] @ OVER))
    torch.testing.assert_close(mixed.base[rows, 0], over.base[rows, 0])
    torch.testing.assert_close(mixed.base[rows, 1], right.base[rows, 0])  # what was said before is the rival
    torch.testing.assert_close(mixed.state[rows, 1], right.state[rows, 0])
    torch.testing.assert_close(mixed.votes.share[rows], over.votes.share[rows])
    assert torch.equal(mixed.base[0], right.base[0]) and torch.equal(mixed.votes.share[2], right.votes.share[2])


def test_views_that_were_turned_over_turn_predictions_over(learnt):
    data = _views(3, seed=2)
    other = ViewSearch(2)
    other.load_state_dict(learnt.state_dict())
    other.base = learnt.base @ se3(OVER, torch.zeros(3))
    found, turned = (search.search(data.points)[0][:, 0, :3, :3] for search in (learnt, other))
    torch.testing.assert_close(turned, found @ OVER)


def test_views_do_not_interact_and_what_was_learnt_is_saved(learnt):
    data = _views(3, seed=3)
    again = ViewSearch(2)
    # Files of weights give all numbers as float32.
    read = {name: value.float() if value.is_floating_point() else value for name, value in learnt.state_dict().items()}
    again.load_state_dict(read)
    assert again.learnt and again.views.dtype == torch.int8
    together, alone = learnt.search(data.points), again.search(data.points[1:2])
    for one, other in zip((*together[:3], *together.votes), (*alone[:3], *alone.votes), strict=True):
        torch.testing.assert_close(one[1:2], other, atol=1e-5, rtol=0)


def test_weights_from_before_there_was_a_search_have_none():
    search = ViewSearch(3)
    search.load_state_dict({})
    assert not search.learnt


@pytest.mark.parametrize(("lying", "kept"), [(30, 5), (3, 3), (96, 6), (0, 0)])
def test_of_what_lies_as_many_views_are_kept_as_of_what_stands(monkeypatch, lying, kept):
    """As many as there are: states say which they were."""
    monkeypatch.setattr(view_search, "_VIEWS", 10)
    quarters = torch.randperm(100, generator=torch.Generator().manual_seed(0)).lt(lying).long() * 3
    of = torch.rand(100, 20, 3), torch.eye(4).repeat(100, 1, 1), torch.arange(100.0)[:, None]
    search = ViewSearch(2)
    search.learn(*of, torch.zeros(100, 20), quarters)
    rows = search.state[:, 0].long()
    assert len(rows.unique()) == 10 and (quarters[rows] > 0).sum() == kept
    assert torch.equal(quarters[rows], search.quarters)
    if kept > 3:  # spread evenly
        assert quarters[: rows[-kept]].count_nonzero() == 0 and quarters[rows[-1] + 1 :].count_nonzero() == 0
    forgotten = ViewSearch(2)
    forgotten.load_state_dict(search.state_dict())
    forgotten.forget()
    assert not forgotten.quarters.any()
    again, earlier = ViewSearch(2), ViewSearch(2)
    again.load_state_dict(search.state_dict())
    assert torch.equal(again.quarters, search.quarters)
    earlier.load_state_dict({name: value for name, value in search.state_dict().items() if name != "quarters"})
    assert earlier.quarters.tolist() == [0] * 10  # of weights from before it was known


def test_few_views_of_few_points_will_do():
    data = _views(5, seed=4)
    search = _learnt(data._replace(points=data.points[:, :100]))
    seen = search.search(data.points[:2, :90])
    assert all(value.isfinite().all() for value in (*seen[:3], *seen.votes)) and seen.votes.share.shape == (2, 90, 2)


@pytest.fixture(scope="module")
def estimator(learnt):
    """With a network that has learnt nothing."""
    data = _views(1, seed=0)
    points = torch.cat([data.rest[data.part == part][:200].repeat(2, 1)[:200] for part in range(2)])
    shape = ArticulatedShape(
        points, torch.arange(2).repeat_interleave(200), Joints(CHAIN, data.axis, data.pivot, REVOLUTE)
    )
    options = NetworkOptions(
        group_order=12, dims=(8, 8, 8), num_neighbors=8, num_centers=(128, 64, 32), head_dim=8, shape_points=200
    )
    torch.manual_seed(0)
    network = ArticulatedNetwork(options, 2, REVOLUTE).eval()
    made = PoseEstimator(network, None, 1, Observation(RANGE, True), 0.05, InferenceOptions(refine=True))
    network.category.adopt(shape)
    return made


def test_the_search_decides_and_hypotheses_turned_alike_compete(learnt, estimator):
    data = _views(3, seed=5)
    points, truth = data.points[:, :256], data.base[:, :3, :3]
    before = estimator.predict(points, 256)
    unregistered = estimator.predict(points, 256, refine=False)
    assert _degrees(before.base_pose[:, :3, :3], truth).max() > 30
    estimator.view_search.load_state_dict(learnt.state_dict())
    with torch.inference_mode():  # as a trainer tests
        found, rival = estimator.predict_with_rivals(points.clone(), 256)
    for prediction in (found, estimator.search(points, data.points)):
        assert _degrees(prediction.base_pose[:, :3, :3], truth).max() < 20
        assert (prediction.joint_state - data.state).abs().median() < 0.3
        assert (prediction.part_id == data.part[:256]).float().mean() > 0.9
        torch.testing.assert_close(prediction.part_probability.sum(dim=-1), torch.ones(3, 256))
    assert found.dense_part_id.shape == (3, 0)  # no more points were given
    every = estimator.search(points, data.points).dense_part_id
    assert every.shape == data.points.shape[:2] and (every == data.part).float().mean() > 0.9
    unsure = found.margin < 1
    assert (_degrees(found.base_pose[:, :3, :3], rival.base_pose[:, :3, :3])[unsure] > 20).all()
    # Without registration the network answers alone.
    again = estimator.predict(points, 256, refine=False)
    torch.testing.assert_close(again.base_pose, unregistered.base_pose)
    # The network's hypotheses that are turned as the search says are registered, and win where they fit better.
    turn = estimator.view_search.search(points)[0][:, 0, :3, :3]
    others = estimator._candidates(points, 256, True, turn)
    near = _degrees(others.base[..., :3, :3], turn[:, None].expand(-1, others.base.shape[1], -1, -1)) < 30
    least = others.error.masked_fill(~near, torch.inf).amin(dim=1)
    assert (found.reconstruction_error <= least + 1e-3).all()


def test_neither_predictions_nor_rivals_ask_for_gradients(learnt, estimator):
    """A rival is the category's own shape, which training may have learnt."""
    points = _views(3, seed=5).points[:, :256]
    estimator.view_search.load_state_dict(learnt.state_dict())
    for said in estimator.predict_with_rivals(points, 128):
        assert not [field.name for field in fields(said) if getattr(getattr(said, field.name), "requires_grad", False)]


class _Camera:
    """Explanations stand; what is sought lies the second time."""

    def __init__(self) -> None:
        self.asked = []

    def stood(self, rotation):
        self.asked.append(len(rotation))
        return rotation, torch.full((len(rotation),), int(len(self.asked) > 1)), None


@torch.no_grad()
@pytest.mark.parametrize("known", [True, False])  # which leaves the estimator as it was
def test_what_is_hinged_otherwise_is_sought_among_its_own_views_and_believed_where_it_fits_better(
    learnt, estimator, monkeypatch, known
):
    """Of three clouds two are explained the wrong way round, the third rightly."""
    data = _views(3, seed=6)
    points = data.points[:, :256]
    views = estimator.view_search
    views.load_state_dict(learnt.state_dict())
    assert not estimator.other_views.lie  # of no view it is known that it lies
    views.quarters = torch.arange(300) % 2
    shown, search = [], views.search
    monkeypatch.setattr(views, "search", lambda points, **of: (shown.append(of["shown"]), search(points, **of))[1])
    camera = _Camera()
    monkeypatch.setattr(UprightCamera, "stood", camera.stood)
    estimator.hinge_sides.camera.learnt.fill_(known)
    base = data.base.clone()
    base[:2, :3, :3] = base[:2, :3, :3] @ OVER
    one = estimator.articulated.category_at(base[:, None], data.state[:, None])
    one = estimator.final.in_proportion(one, points, data.points)
    votes = search(points).votes
    votes = votes._replace(share=torch.full_like(votes.share, 0.5))
    sought = estimator.other_views.sought
    found, rival, margin, said, _ = sought(one, one, torch.full((3,), 2.0), votes, points, data.points)
    if not known:
        assert found is one and said is votes and not shown
        return
    assert camera.asked == [3, 3]
    assert torch.equal(shown[0], torch.arange(0, 300, 2)) and torch.equal(shown[1], torch.arange(1, 300, 2))
    assert _degrees(found.base[:, 0, :3, :3], data.base[:, :3, :3]).max() < 20
    error, before = (estimator.final.distance(this, points) for this in (found, one))
    assert (error <= before).all()
    torch.testing.assert_close(rival.base, one.base)
    torch.testing.assert_close(margin[:2], 1 - error[:2] / before[:2])
    assert (margin[:2] > 0).all() and margin[2] == 2  # nothing that is turned another way was tried of it
    assert (said.share[:2] != 0.5).any()


@torch.no_grad()
def test_what_is_hinged_otherwise_and_fits_worse_is_a_rival_if_none_is_nearer(learnt, estimator, monkeypatch):
    data = _views(3, seed=7)
    points = data.points[:, :256]
    views = estimator.view_search
    views.load_state_dict(learnt.state_dict())
    views.quarters = torch.arange(300) % 2
    views.base = torch.where(views.quarters.bool()[:, None, None], views.base @ se3(OVER, torch.zeros(3)), views.base)
    monkeypatch.setattr(UprightCamera, "stood", _Camera().stood)
    estimator.hinge_sides.camera.learnt.fill_(True)
    one = estimator.articulated.category_at(data.base[:, None], data.state[:, None])
    one = estimator.final.in_proportion(one, points, data.points)
    margin = torch.tensor([1.0, 1.0, 1e-4])
    found, rival, said, *_ = estimator.other_views.sought(one, one, margin, learnt.search(points).votes, points, None)
    assert _degrees(found.base[:, 0, :3, :3], data.base[:, :3, :3]).max() < 20
    assert _degrees(rival.base[:2, 0, :3, :3], data.base[:2, :3, :3]).min() > 90
    torch.testing.assert_close(rival.base[2], one.base[2])
    error, other = (estimator.final.distance(this, points) for this in (found, rival))
    torch.testing.assert_close(said[:2], 1 - error[:2] / other[:2])
    assert (said[:2] > 0.02).all() and said[2] == 1e-4


@torch.no_grad()
def test_closed_doors_are_sought_among_their_own_views_and_believed_where_they_fit_clearly_better(learnt, estimator):
    """Of three clouds two are explained the wrong way round, the third rightly; nobody knows which way is up."""
    data = _views(3, seed=8)
    points = data.points[:, :256]
    base = data.base.clone()
    base[:2, :3, :3] = base[:2, :3, :3] @ OVER
    one = estimator.articulated.category_at(base[:, None], data.state[:, None])
    one = estimator.final.in_proportion(one, points, data.points)
    given = one, one, torch.full((3,), 2.0), learnt.search(points).votes, points, data.points
    estimator.hinge_sides.camera.learnt.fill_(False)
    assert estimator.other_views.sought(*given)[0] is one
    estimator.closed_views.load_state_dict(learnt.state_dict())
    try:
        found, rival, margin, *_ = estimator.other_views.sought(*given)
        error, before = (estimator.final.distance(this, points) for this in (found, one))
        assert _degrees(found.base[:, 0, :3, :3], data.base[:, :3, :3]).max() < 20
        assert (error[:2] < CLEARLY * before[:2]).all()
        torch.testing.assert_close(rival.base[:2], one.base[:2])
        torch.testing.assert_close(margin[:2], 1 - error[:2] / before[:2])
        # What fits about as well stays as it was.
        torch.testing.assert_close(found.base[2], one.base[2])
        # A door that is open as no joint can be is no explanation.
        estimator.states.seen.copy_(torch.tensor([[8.0, 9.0]]))
        estimator.states.set_rest(8.5)
        torch.testing.assert_close(estimator.other_views.sought(*given)[0].base, one.base)
    finally:
        estimator.closed_views.forget()
        estimator.states.forget()


@torch.no_grad()
@pytest.mark.parametrize("worse, gives_way", [(1.2, True), (1.4, False)])
def test_doors_that_are_open_as_no_joint_can_be_give_way_to_closed_ones_that_fit_about_as_well(
    learnt, estimator, monkeypatch, worse, gives_way
):
    """Of two clouds the first is explained by such a door."""
    data = _views(2, seed=8)
    points = data.points[:, :256]
    state = data.state.clone()
    state[0] += 20
    one = estimator.articulated.category_at(data.base[:, None], state[:, None])
    fits = lambda this, points: torch.full((len(points),), 1.0 if this is one else worse)  # noqa: E731
    monkeypatch.setattr(estimator.final, "distance", fits)
    estimator.hinge_sides.camera.learnt.fill_(False)
    estimator.closed_views.load_state_dict(learnt.state_dict())
    estimator.states.seen.copy_(torch.tensor([[-3.0, 3.0]]))
    given = one, one, torch.full((2,), 2.0), learnt.search(points).votes, points, data.points
    try:
        found = estimator.other_views.sought(*given)[0]
        assert torch.equal(found.state[1], one.state[1])
        assert (found.state[0, 0, 0] < 3) == gives_way and torch.equal(found.state[0], one.state[0]) != gives_way
    finally:
        estimator.closed_views.forget()
        estimator.states.forget()


class _Likes(torch.nn.Module):
    """To it boxes look right as it is told, by so much."""

    def __init__(self, right: torch.Tensor, by: float) -> None:
        super().__init__()
        self.right, self.by, self.read = right, by, []
        self.register_buffer("temperature", torch.tensor(1.0))

    def looks_right(self, frames, dense):
        self.read.append(dense.shape)
        best = _degrees(frames, self.right[:, None].expand_as(frames)).argmin(dim=1)
        return torch.zeros(frames.shape[:2]).index_put((torch.arange(len(frames)), best), torch.tensor(self.by))


@torch.no_grad()
@pytest.mark.parametrize(
    "case, worse, reaches, by, gives_way",
    [
        ("looks outweigh a little worse fits", 1.15, 0.0, 8.0, True),
        ("and no more than that", 1.4, 0.0, 8.0, False),
        ("which looks a little righter has to fit", 1.15, 0.0, 1.0, False),
        ("the other reaches into free space", 1.15, 0.4, 0.0, True),
        ("what is sought in a way ends in another", 1.15, 0.4, 0.0, False),
        ("no camera sees it", 1.0, 0.3, 8.0, False),
        ("it is square to nothing", 1.0, 0.3, 8.0, False),
    ],
)
def test_boxes_are_explained_in_every_way_and_fits_and_free_space_and_looks_decide(
    learnt, estimator, monkeypatch, case, worse, reaches, by, gives_way
):
    """Three clouds, of which two are explained the wrong way round, which fits; to a network the truth looks right."""
    data = _views(3, seed=8)
    points, truth = data.points[:, :256], data.base[:, :3, :3]
    base = data.base.clone()
    base[:2, :3, :3] = base[:2, :3, :3] @ OVER
    one = estimator.articulated.category_at(base[:, None], data.state[:, None])

    turned = []  # what was asked for its shape last

    def right(turn):  # of the clouds that are explained wrongly
        return _degrees(turn[:, None], truth[None, :2].expand(len(turn), -1, -1, -1)).amin(dim=1) < 20

    def third(turn):
        return _degrees(turn, truth[2].expand_as(turn)) < 20

    def allows(_, turn):  # two ways of each
        ways = (base[:, :3, :3],) if case == "no camera sees it" else (base[:, :3, :3], truth)
        return sum(_degrees(turn, way[:, None].expand_as(turn)) < 5 for way in ways) > 0

    def distance(this, _):
        turn = this.base[:, 0, :3, :3]
        return torch.where(right(turn), worse, 1.0) - 0.5 * third(turn)

    def posed(this, posed=other_views.Hypotheses.posed):
        turned.append(this.base[:, 0, :3, :3])
        return posed(this)

    ways = []  # in which views of both kinds were asked

    def search(this, points, turn=None, shown=None, search=ViewSearch.search):
        if turn is not None:
            ways.append(turn)
        return search(this, points, turn, shown)

    def entered(*_):
        return torch.where(right(turned[-1]) | third(turned[-1]), 0.0, reaches)

    if case == "what is sought in a way ends in another":
        monkeypatch.setattr(other_views, "ANOTHER_WAY", 0.0)
    angle = torch.full((3,), CAP if case == "it is square to nothing" else 1.0)
    monkeypatch.setattr(other_views, "manhattan_frames", lambda dense, _: (truth.mT, angle))
    monkeypatch.setattr(estimator.final, "distance", distance)
    monkeypatch.setattr(UprightCamera, "stood", _stands)
    monkeypatch.setattr(Observation, "allows", allows)
    monkeypatch.setattr(other_views.Hypotheses, "posed", posed)
    monkeypatch.setattr(other_views.FreeSpace, "entered", entered)
    monkeypatch.setattr(ViewSearch, "search", search)
    estimator.hinge_sides.camera.learnt.fill_(False)
    estimator.view_search.load_state_dict(learnt.state_dict())
    estimator.closed_views.load_state_dict(learnt.state_dict())
    estimator.states.seen.copy_(torch.tensor([[-3.0, 3.0]]))
    estimator.states.set_rest(-3.0)
    estimator.box_turns.surface = likes = _Likes(truth, by)
    votes = learnt.search(points).votes
    votes = votes._replace(share=torch.full_like(votes.share, 0.5))
    given = one, one, torch.full((3,), 2.0), votes, points, data.points
    try:
        sought = estimator.other_views.sought(*given)
        assert likes.read == [(3, 512, 3)]
        assert torch.equal(sought.one.base[2], one.base[2]) and (sought.votes.share[2] == 0.5).all()
        if not gives_way:
            assert torch.equal(sought.one.base, one.base) and (sought.votes.share == 0.5).all()
            return
        assert len(ways) == 2 and all(torch.equal(way, truth[:2]) for way in ways), "not in the way that it is turned"
        assert right(sought.one.base[:2, 0, :3, :3]).all()
        assert torch.equal(sought.rival.base[:2], one.base[:2])
        before = (1 + other_views._REACHES * reaches) * math.exp(other_views._LOOKS * min(by, other_views._UNLIKELY))
        torch.testing.assert_close(sought.error[:2], torch.full((2,), worse))
        torch.testing.assert_close(sought.margin[:2], torch.full((2,), 1 - worse / before), atol=1e-3, rtol=0)
        assert (sought.votes.share[:2] != 0.5).flatten(1).any(dim=1).all()
    finally:
        estimator.box_turns.surface = None
        estimator.closed_views.forget()
        estimator.states.forget()


def test_what_is_turned_about_as_a_way_that_is_seen_looks_so_and_all_else_as_unlikely_as_any():
    ways = torch.stack([torch.eye(3), OVER]).expand(4, 2, 3, 3)
    turn = roma.rotvec_to_rotmat(torch.tensor([[0, 0.1, 0], [0, 3.0, 0], [0, 1.6, 0], [0, 0.1, 0]]))
    likely = torch.tensor([[-1.0, 0], [-1.0, 0], [-1.0, 0], [-torch.inf, 0]])
    least = -other_views._UNLIKELY
    assert other_views._looks_of(other_views.angle_to(ways, turn), likely).tolist() == [-1, 0, least, least]


def _stands(_, turn):
    """Whatever it is, it stands."""
    return turn, torch.zeros(turn.shape[:-2]).long(), torch.ones(turn.shape[:-2]).bool()


@torch.no_grad()
def test_where_closed_doors_were_seen_it_is_known_at_which_state_they_are(learnt, estimator):
    """Weights whose joint limits were learnt anew find it out again."""
    estimator.states.seen.copy_(torch.tensor([[-1.0, 0.5]]))
    try:
        estimator.other_views.measure()
        assert not estimator.states.rests
        estimator.closed_views.load_state_dict(learnt.state_dict())
        estimator.other_views.measure()
        shape = estimator.articulated.category.articulated_shape(REVOLUTE)
        closed = closed_state(shape, estimator.states.known, estimator.part_frames)
        assert estimator.states.rests and float(estimator.states.rest) == pytest.approx(closed)
    finally:
        estimator.closed_views.forget()
        estimator.states.forget()
