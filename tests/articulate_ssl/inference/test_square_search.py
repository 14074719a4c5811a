"""Boxes with doors that are open as training showed none are found from the rotations of the cube."""

import math
from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import OVEN, clouds, true_shape
from true_category import final_fit

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.box_turns import BoxTurns, Looks
from articulate_ssl.inference.hinge_sides import HingeSides
from articulate_ssl.inference.square_search import SquareSearch
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.shape.observation import Observation

TURNED = roma.rotvec_to_rotmat(torch.tensor([0.0, math.pi / 2, 0.0]))
NEARLY_CLOSED = (*OVEN[:3], [(0.05, 0.25)], OVEN[4])


@pytest.fixture
def data():
    return clouds(NEARLY_CLOSED, count=4, points=1024, resample=True)


@pytest.fixture
def search(data) -> SquareSearch:
    states = StateRange(1)
    states.seen.copy_(torch.tensor([[0.6, 1.6]]))
    states.limits.copy_(states.seen)
    final = final_fit(true_shape(OVEN, data), states)
    final.part_frames.flat.fill_(True)
    sides = HingeSides()
    sides.axes.copy_(torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]))  # the door is in front, along x
    return SquareSearch(final, sides, BoxTurns())


def _at(search: SquareSearch, base, state):
    return search.final.articulated.category_at(base[:, None], state[:, None])


def _squares(base, state):
    """What is square to faces, as registered: [B, C, 4, 4], [B, C, 1], best first."""
    return base, state, torch.arange(base.shape[1]).expand(base.shape[:2])


def _turned(data):
    """Ovens on their backs, doors opened as in training."""
    base = data.base.clone()
    base[:, :3, :3] = base[:, :3, :3] @ TURNED
    return base, torch.full_like(data.state, 1.0)


def _off(one, data):
    return roma.rotmat_geodesic_distance(one.base[:, 0, :3, :3], data.base[:, :3, :3]).rad2deg()


def test_it_is_measured_where_a_door_is_closed(search):
    states = search.final.registration.states
    assert not states.rests and torch.equal(states.possible, states.seen)
    search.measure()
    assert float(states.rest) == pytest.approx(0, abs=0.1)
    torch.testing.assert_close(states.possible, torch.stack([states.rest, states.seen[:, 1]], dim=1))
    states.set_rest(0.5)
    search.measure()  # once is enough
    assert float(states.rest) == 0.5


def test_closed_doors_are_found_though_training_showed_none(search, data):
    search.measure()
    base, state = _turned(data)
    wrong = _at(search, base, state)
    margin = torch.tensor([0.1, 0.1, 0.9, 0.9])
    one, rival, new = search.sought(wrong, wrong, margin, data.points, data.points)
    assert (_off(one, data)[:2] < 10).all()
    torch.testing.assert_close(one.state[:2, 0], data.state[:2], atol=0.1, rtol=0)
    assert (_off(rival, data)[:2] > 30).all()  # what gave way, or what was tried and is turned another way
    assert (new[:2] > 0).all() and (new[:2] < 1).all()
    # Whoever is sure of what training showed is doubted where the best square explanation is turned another way.
    assert (_off(one, data)[2:] < 10).all()
    # However sure, what training did not show is sought again.
    beyond = _at(search, base, state + 2.0)
    one, _, _ = search.sought(beyond, beyond, torch.ones(4), data.points, data.points)
    assert (_off(one, data) < 10).all()


def test_what_square_explanations_agree_with_is_taken_as_it_is(search, data, monkeypatch):
    search.measure()
    one = _at(search, data.base, torch.full_like(data.state, 1.0))  # as training showed
    asked = []
    monkeypatch.setattr(search, "_square", lambda *_: _squares(data.base[:, None], data.state[:, None]))
    monkeypatch.setattr(search.final, "in_proportion", lambda tried, *_: asked.append(len(tried.base)) or tried)
    margin = torch.tensor([0.9, 0.9, 0.9, 0.1])
    found, rival, new = search.sought(one, one, margin, data.points, data.points)
    assert asked == [1]  # the last: another explanation fits nearly as well
    assert torch.equal(found.state[:3], one.state[:3]) and torch.equal(found.state[3, 0], data.state[3])
    assert torch.equal(rival.base, one.base) and torch.equal(new, margin)


def test_what_training_showed_gives_way_only_to_what_fits_clearly_better(search, data, monkeypatch):
    search.measure()
    right = search.final.in_proportion(_at(search, data.base, data.state), data.points, data.points)
    turned, state = _turned(data)
    monkeypatch.setattr(search, "_square", lambda *_: _squares(turned[:, None], state[:, None]))
    error = {True: 1.0, False: 0.96}
    monkeypatch.setattr(
        search.final,
        "distance",
        lambda one, _points: torch.full((len(one.base),), error[bool((_off(one, data) < 30).all())]),
    )
    search.final.registration.states.seen.copy_(torch.tensor([[0.0, 1.6]]))
    one, rival, margin = search.sought(right, right, torch.zeros(4), data.points, data.points)
    assert torch.equal(one.base, right.base)
    error[False] = 0.9
    one, rival, margin = search.sought(right, right, torch.zeros(4), data.points, data.points)
    assert (_off(one, data) > 60).all() and torch.equal(rival.base, right.base)
    torch.testing.assert_close(margin, torch.full((4,), 0.1))


def _looking_right(search, monkeypatch, data, odds, alike=0.0):
    """The search, told by looks that objects are turned as they are, and with what odds not as `_turned` ones.

    And with what odds training clouds that are alike say so, too.
    """
    monkeypatch.setattr(BoxTurns, "learnt", True)
    every = data.base[:, None, :3, :3] @ rotation_group(24).elements.float()
    likely = torch.full((len(every), 24), -20.0)
    likely[:, 0] = 0.0
    turned = (every * (data.base[:, None, :3, :3] @ TURNED)).sum(dim=(-2, -1)).argmax(dim=1)
    likely[torch.arange(len(every)), turned] = -torch.tensor(odds)
    like_others = torch.full((len(every), 24), -20.0 * bool(alike)).index_fill(1, torch.tensor([0]), 0.0)
    like_others[torch.arange(len(every)), turned] = -float(alike)
    found = likely.log_softmax(dim=1), like_others
    monkeypatch.setattr(search.turns, "looks", lambda *seen: Looks(every, found[0], *seen[2:], found[1]))


def _fitting(search, monkeypatch, data, error):
    """The search, told how well what is turned as objects are fits; the rest does by 1."""
    right = [tuple(rotation.flatten().tolist()) for rotation in data.base[:, :3, :3]]

    def distance(one, _points):
        turned = [tuple(rotation.flatten().tolist()) for rotation in one.base[:, 0, :3, :3]]
        return torch.tensor([error if rotation in right else 1.0 for rotation in turned])

    monkeypatch.setattr(search.final, "in_proportion", lambda tried, *_: tried)
    monkeypatch.setattr(search.final, "distance", distance)


@pytest.mark.parametrize("error", [3.0, 1.5, 0.9])
def test_what_looks_right_counts_as_what_fits_does(search, data, monkeypatch, error):
    """Of what is by 9 less likely errors are e^(9/12) times as large, or 2.12; of what is by 1, e^(1/12), or 1.09.

    And e^(2/12) times where a door stands as training showed none. What looks undecided is not asked, if its door
    stands as training showed it.
    """
    search.measure()
    wrong, state = _turned(data)
    _looking_right(search, monkeypatch, data, [9.0, 9.0, 1.0, 1.0])
    _fitting(search, monkeypatch, data, error)
    squares = _squares(torch.stack([wrong, data.base], dim=1), torch.stack([state, data.state], dim=1))
    monkeypatch.setattr(search, "_square", lambda *_: squares)
    said, sure = _at(search, wrong, state), torch.full((4,), 0.9)
    one, rival, margin = search.sought(said, said, sure, data.points, data.points)
    kept, better, worse = error > math.exp(7 / 12), data.base, wrong
    if kept:
        better, worse = worse, better
    assert torch.equal(one.base[:2, 0], better[:2]) and torch.equal(one.base[2:], said.base[2:])
    assert torch.equal(rival.base[:2, 0], worse[:2])
    left = 1 - math.exp(7 / 12) / error if kept else math.tanh(4.5)
    torch.testing.assert_close(margin, torch.tensor([left] * 2 + [0.9] * 2), atol=1e-3, rtol=0)
    closed = _at(search, wrong, data.state)
    one, _, _ = search.sought(closed, closed, sure, data.points, data.points)
    assert torch.equal(one.base[:2, 0], better[:2])
    assert torch.equal(one.base[2:, 0], (data.base if error < math.exp(-1 / 12) else wrong)[2:])


def test_what_looks_right_as_training_showed_it_is_taken_as_it_is(search, data, monkeypatch):
    """Whatever else would fit, and is believed as far as looks are."""
    search.measure()
    wrong, state = _turned(data)
    _looking_right(search, monkeypatch, data, [3.0] * 4)
    monkeypatch.setattr(search, "_square", lambda *_: _squares(wrong[:, None], state[:, None]))
    monkeypatch.setattr(search.final, "in_proportion", lambda *_: pytest.fail("tried in vain"))
    right = _at(search, data.base, torch.full_like(data.state, 1.0))
    one, _, margin = search.sought(right, right, torch.tensor([0.0, 0.5, 0.95, 1.0]), data.points, data.points)
    assert one is right
    torch.testing.assert_close(margin, torch.tensor([math.tanh(1.5)] * 2 + [0.95, 1.0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("error", [1.05, 1.15])
def test_what_the_network_alone_says_counts_as_well(search, data, monkeypatch, error):
    """By e^(1/12), or 1.09. Where it turns objects another way, what looks undecided is doubted."""
    search.measure()
    wrong, state = _turned(data)
    _looking_right(search, monkeypatch, data, [0.0] * 4)
    _fitting(search, monkeypatch, data, error)
    monkeypatch.setattr(search, "_square", lambda *_: _squares(data.base[:, None], state[:, None]))
    one, sure = _at(search, wrong, state), torch.full((4,), 0.9)
    sought = [
        search.sought(one, one, sure, data.points, data.points, said)[0].base[:, 0]
        for said in (data.base[:, :3, :3], wrong[:, :3, :3], None)
    ]
    assert torch.equal(sought[0], data.base if error < math.exp(1 / 12) else wrong)
    assert torch.equal(sought[1], wrong) and torch.equal(sought[2], wrong)


@pytest.mark.parametrize("error", [1.2, 1.4, 2.7])
@pytest.mark.parametrize("odds", [0.0, -9.0])
def test_what_is_like_training_clouds_counts_as_well_and_is_tried_if_it_looks_wrong(
    search, data, monkeypatch, error, odds
):
    """By e^(3/12), or 1.28; with looks against it, by e^(-6/12)."""
    search.measure()
    wrong, state = _turned(data)
    _looking_right(search, monkeypatch, data, [odds] * 4, alike=3.0)
    _fitting(search, monkeypatch, data, error / 2)
    monkeypatch.setattr(search, "_square", lambda *_: _squares(data.base[:, None], state[:, None]))
    one, sure = _at(search, wrong, state), torch.full((4,), 0.9)
    found, _, _ = search.sought(one, one, sure, data.points, data.points)
    wins = error / 2 < math.exp((3.0 + odds) / 12)
    assert torch.equal(found.base[:, 0], data.base if wins else wrong)


@pytest.mark.parametrize(
    "learnt, elsewhere, opened",
    [(True, 0.99, 1), (True, 0.999, 1), (True, 1.1, 1), (False, 0.9, 1), (True, 0.9, 0), (True, 0.95, 0)],
)
def test_hinges_may_be_at_other_sides(search, data, monkeypatch, learnt, elsewhere, opened):
    """An object that stands as it looks may be hinged elsewhere, where some are.

    The fewer are, the better that has to fit: as both stand alike, of an eighth by e^(ln(8) / 30), or 1.07, of which a
    door that stands as training showed makes up for e^(2 / 30).
    """
    fewer = math.exp((2 * opened - math.log(8)) / 30)
    search.measure()
    search.sides.learnt.fill_(learnt)
    search.sides.log_prior[1:] = -math.log(8)
    _looking_right(search, monkeypatch, data, [9.0] * 4)
    category = search.final.articulated.shape
    ways = []

    def square(_points, _frames, rotations, shape):
        most, count = shape is category, rotations.shape[1]
        ways.append(count)
        count = 1 if most else count
        base, state = data.base[:, None].expand(-1, count, -1, -1), data.state if most else float(opened)
        return _squares(base, torch.zeros(len(base), count, 1) + (state[:, None] if most else state))

    def distance(one, _points):
        return torch.where(_elsewhere(search, one), elsewhere, 1.0)

    monkeypatch.setattr(search, "_square", square)
    monkeypatch.setattr(search.final, "in_proportion", lambda tried, *_: tried)
    monkeypatch.setattr(search.final, "distance", distance)
    said = _at(search, _turned(data)[0], data.state)  # as training showed none
    one, rival, _ = search.sought(said, said, torch.ones(4), data.points, data.points)
    assert ways == ([24, 3, 3, 3] if learnt else [24])
    won = learnt and elsewhere < fewer
    assert (_elsewhere(search, one) == won).all() and (_off(one, data) < 1).all()
    assert not _elsewhere(search, rival).any()
    # What is said to lie, as training showed it, is hinged elsewhere; it gives way to what fits better.
    lies = data.base.clone()
    lies[:, :3, :3] = lies[:, :3, :3] @ roma.rotvec_to_rotmat(torch.tensor([math.pi / 2, 0.0, 0.0]))
    said = _at(search, lies, torch.full_like(data.state, 1.0))
    one, _, _ = search.sought(said, said, torch.ones(4), data.points, data.points)
    assert (_off(one, data) < 1).all() and (_elsewhere(search, one) == won).all()


def _elsewhere(search, one):
    return (one.axis[:, 0, 0] - search.final.articulated.shape.joints.axis[0]).norm(dim=-1) > 0.5


def test_rivals_that_are_hinged_elsewhere_lie(search, data):
    """They are kept as the category is hinged, where their doors are."""
    search.measure()
    search.sides.learnt.fill_(True)
    standing = search.final.hinged_at(_at(search, data.base, data.state), search._other_hinge(1))
    lying = search._as_rival(standing)
    assert _elsewhere(search, standing).all() and not _elsewhere(search, lying).any()
    turn = roma.rotmat_geodesic_distance(lying.base[:, 0, :3, :3], data.base[:, :3, :3])
    torch.testing.assert_close(turn, torch.full((4,), math.pi / 2), atol=1e-3, rtol=0)
    axes = [(one.base[:, 0, :3, :3] @ one.axis[:, 0, 0, :, None])[..., 0] for one in (standing, lying)]
    torch.testing.assert_close(*axes, atol=1e-5, rtol=0)
    middles = [(one.posed()[:, 0, 0]).mean(dim=1) for one in (standing, lying)]
    torch.testing.assert_close(*middles, atol=1e-5, rtol=0)
    assert torch.equal(search._as_rival(_at(search, data.base, data.state)).base, data.base[:, None])
    # Where none is hinged elsewhere, nothing is known of how the box lies.
    search.sides.learnt.fill_(False)
    search.sides.axes.copy_(torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    assert torch.equal(search._as_rival(_at(search, data.base, data.state)).base, data.base[:, None])


@pytest.mark.parametrize("where", ["views", "plates", "not faces", "no dense points"])
def test_elsewhere_nothing_is_sought(search, data, where):
    final = search.final
    if where == "views":
        final.registration.observation = replace(Observation(), unidirectional=True)
    if where == "plates":
        thin = final.articulated.shape
        flat = replace(thin, points=thin.points * torch.tensor([1, 1, 0.1]))
        final.articulated.category.articulated_shape = lambda _type: flat
    if where == "not faces":
        final.part_frames.flat[1] = False
    search.measure()
    assert bool(final.registration.states.rests) == (where == "no dense points")
    wrong = _at(search, *_turned(data))
    dense = None if where == "no dense points" else data.points
    one, rival, margin = search.sought(wrong, wrong, torch.zeros(4), data.points, dense)
    assert one is wrong and rival is wrong and not margin.any()
