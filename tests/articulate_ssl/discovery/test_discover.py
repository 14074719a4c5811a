"""Parts and joints of a category are found from its clouds alone."""

from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import permutations

import pytest
import roma
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape
from twin_objects import with_coarse_slides

from articulate_ssl.discovery.discover import DiscoveryError, _rounds, discover
from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.proposals import load_proposals
from articulate_ssl.discovery.proposals.random_cuts import random_split
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registrar import Registrar
from articulate_ssl.discovery.registration import chamfer_l1
from articulate_ssl.shape.stretch import hinged, principal_directions, stretch_matrices

RANDOM = ["random_cuts"]


def _agreement(found: torch.Tensor, true: torch.Tensor, num_parts: int) -> float:
    """Share of the points with the right label, whichever way parts are numbered."""
    orders = torch.tensor(list(permutations(range(num_parts))))
    return (orders[:, found] == true).float().mean(dim=1).max().item()


@pytest.mark.parametrize(
    ("design", "agreement"),
    # A drawer's sides lie against those of its cabinet: what hides there belongs to either.
    [(LAPTOP, 0.9), (DRAWER, 0.75), (GLASSES, 0.85)],
    ids=["laptop", "drawer", "glasses"],
)
def test_the_parts_are_those_that_move(design, agreement):
    num_parts, joint_type = len(design[0]), design[4]
    data = clouds(design, count=12, points=256, resample=True, seed=1)
    small = DiscoveryOptions(
        clouds=12,
        search_clouds=12,
        split_clouds=10,
        references=1,
        starts=6,
        jointed=2,
        rounds=1,
        proposals=RANDOM,
        cycles=4,
    )
    found = discover(data.points, num_parts, joint_type, small)
    assert _agreement(found.shape.label, data.part, num_parts) > agreement
    if num_parts == 2:  # which of three parts is the root is not determined
        assert torch.corrcoef(torch.stack([found.state[:, 0], data.state[:, 0]]))[0, 1].abs() > 0.9
    by_chance = random_split(data.rest, num_parts, torch.Generator().manual_seed(0))
    assert _agreement(by_chance, data.part, num_parts) < agreement


def test_what_slides_is_found_in_a_frame_that_all_clouds_share(monkeypatch):
    """With points enough for normals, orientation is not up to free registration, which turns sliding parts at will."""
    with_coarse_slides(monkeypatch)
    data = clouds(DRAWER, count=10, points=1024, resample=True, seed=1)
    small = DiscoveryOptions(
        clouds=10, search_clouds=10, split_clouds=8, references=1, proposals=["slides"], rounds=1, cycles=2
    )
    found = discover(data.points, 2, DRAWER[4], small)
    frame = found.base[:, :3, :3].mT @ data.base[:, :3, :3]  # the same for all clouds
    turned = roma.rotmat_geodesic_distance(frame[:, None], frame).rad2deg().median(dim=1).values
    assert turned.max() < 5
    assert torch.corrcoef(torch.stack([found.state[:, 0], data.state[:, 0]]))[0, 1].abs() > 0.7
    assert _agreement(found.shape.label, data.part, 2) > 0.7
    axis = found.base[:, :3, :3] @ found.shape.joints.axis[0]
    assert (axis * (data.base[:, :3, :3] @ data.axis[0])).sum(dim=1).abs().min() > 0.98


def test_the_same_clouds_give_the_same_parts_whatever_the_random_state():
    data = clouds(LAPTOP, count=6, resample=True)
    small = DiscoveryOptions(
        clouds=6,
        search_clouds=6,
        split_clouds=6,
        points=64,
        references=1,
        starts=2,
        jointed=1,
        rounds=1,
        proposals=RANDOM,
        cycles=2,
    )
    torch.manual_seed(1)
    first = discover(data.points, 2, LAPTOP[4], small)
    torch.manual_seed(2)
    second = discover(data.points, 2, LAPTOP[4], small)
    assert torch.equal(first.base, second.base) and torch.equal(first.shape.label, second.shape.label)


@dataclass(frozen=True)
class _Onlooker(Registrar):
    """Says of how many clouds what it is given is, and registers nothing."""

    given: list[int] = field(default_factory=list)

    def register(self, found, clouds):
        self.given.append(len(found.state))
        return found


def test_clouds_whose_joints_are_where_the_search_ended_do_not_count_in_a_round():
    data = clouds(LAPTOP, count=6)
    fit = InstanceFit(true_shape(LAPTOP, data), data.base, data.state, torch.Generator().manual_seed(0))
    low, high = data.state.min(), data.state.max()
    few = DiscoveryOptions(rounds=1, cycles=1, keep=1.0)
    found = RegisteredShape.of(fit, data.points)
    given = []
    for sought in ([low - 1, high + 1], [low, high + 1], [low, high]):
        onlooker = _Onlooker(few, torch.Generator().manual_seed(0))
        _rounds(replace(found, sought=torch.tensor([sought])), data.points, data.points, onlooker)
        given += onlooker.given
    assert given == [6, 5, 4]


def test_three_parts_make_a_tree_of_two_joints():
    data = clouds(GLASSES, count=8, points=96, resample=True)
    small = DiscoveryOptions(
        clouds=8,
        search_clouds=8,
        split_clouds=8,
        points=96,
        references=1,
        starts=4,
        jointed=3,
        rounds=0,
        proposals=RANDOM,
        cycles=4,
    )
    found = discover(data.points, 3, GLASSES[4], small)
    chain = found.shape.joints.chain
    assert found.state.shape == (8, 2) and {chain.root, *chain.child} == {0, 1, 2}
    assert found.shape.joints.axis[0] @ found.shape.joints.axis[1] >= 0
    assert set(found.shape.label.tolist()) == {0, 1, 2}
    assert found.error.isfinite().all()


def test_impossible_numbers_of_parts_are_refused():
    data = clouds(LAPTOP, count=4)
    small = DiscoveryOptions(
        clouds=4, search_clouds=4, split_clouds=4, points=48, references=1, starts=2, rounds=0, min_share=0.3
    )
    with pytest.raises(RuntimeError, match="do not show 6 parts"):
        discover(data.points, 6, LAPTOP[4], small)


def test_a_category_that_does_not_move_is_refused():
    copies = clouds(LAPTOP, count=1).points.expand(6, -1, -1).contiguous()
    small = DiscoveryOptions(
        clouds=6, search_clouds=6, split_clouds=6, points=64, references=1, starts=2, jointed=1, rounds=0, cycles=2
    )
    with pytest.raises(DiscoveryError, match="no part that moves in any split of"):
        discover(copies, 2, LAPTOP[4], small)


TOY = '''
"""Proposes what it was told."""

from articulate_ssl.discovery.proposals import Split

LABELS = []


def propose(scene):
    return [Split(label, refined=False) for label in LABELS]
'''


def test_a_proposal_is_a_file_and_a_name_in_the_options(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "__init__.py").touch()
    (tmp_path / "mine" / "toy.py").write_text(TOY)
    monkeypatch.syspath_prepend(tmp_path)
    data = clouds(LAPTOP, count=6, points=128)
    small = DiscoveryOptions(
        clouds=6, search_clouds=6, split_clouds=6, references=1, proposals=["mine.toy"], rounds=0, cycles=2
    )
    with pytest.raises(DiscoveryError):  # nothing proposed, nothing found
        discover(data.points, 2, LAPTOP[4], small)
    toy = import_module("mine.toy")
    toy.LABELS.append(data.part)  # every cloud of this object has the same points in the same order
    found = discover(data.points, 2, LAPTOP[4], small)
    assert (found.shape.label == data.part).float().mean() > 0.95


@pytest.mark.parametrize("name", ["magic", "no.such.module", "articulate_ssl.discovery.options"])
def test_a_proposal_that_does_not_exist_is_named(name):
    with pytest.raises(ValueError, match=f"no proposal '{name}'.*random_cuts"):
        load_proposals(["random_cuts", name])


def test_what_is_handed_over_reconstructs_the_clouds():
    data = clouds(LAPTOP, count=8, points=256, resample=True, proportions=0.15)
    small = DiscoveryOptions(
        clouds=8,
        search_clouds=8,
        split_clouds=8,
        references=1,
        starts=4,
        jointed=2,
        proposals=RANDOM,
        rounds=1,
        cycles=4,
    )
    found = discover(data.points, 2, LAPTOP[4], small)
    axes = torch.stack([principal_directions(found.shape.part(part)) for part in range(2)])
    root = found.shape.part(found.shape.joints.chain.root)

    def error(log_stretch):
        maps, pivots = hinged(stretch_matrices(axes, log_stretch), root.mean(dim=0), found.shape.joints)
        joints = replace(found.shape.joints, pivot=pivots)
        posed = maps.then(joints.part_pose(found.base, found.state)).move(found.shape.points, found.shape.label)
        return chamfer_l1(data.points, posed).mean()

    assert error(found.log_stretch) < 0.97 * error(torch.zeros_like(found.log_stretch))
    low, high = found.limits().unbind(-1)
    assert (low < found.state.median(dim=0).values).all() and (found.state.median(dim=0).values < high).all()
