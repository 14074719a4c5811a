"""Parts and joints of a category are found from its clouds alone."""

from itertools import permutations

import pytest
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, OVEN, clouds

from articulate_ssl.kinematic_chain import KinematicChain
from articulate_ssl.recipes.instance_fit import InstanceFit
from articulate_ssl.recipes.part_discovery import (
    DiscoveryError,
    DiscoveryOptions,
    choose_references,
    discover,
    hinged_at_edges,
    random_split,
    slab_cuts,
    unrest_cuts,
)
from articulate_ssl.registration import JointModel, LabelledTemplate


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
    data = clouds(design, count=18, points=256, resample=True, seed=1)
    small = DiscoveryOptions(
        clouds=18, search_clouds=18, split_clouds=14, references=1, starts=6, jointed=3, rounds=1, cuts=False, cycles=6
    )
    found = discover(data.points, num_parts, joint_type, small)
    assert _agreement(found.template.label, data.part, num_parts) > agreement
    if num_parts == 2:  # which of three parts is the root is not determined
        assert torch.corrcoef(torch.stack([found.state[:, 0], data.state[:, 0]]))[0, 1].abs() > 0.9
    by_chance = random_split(data.rest, num_parts, torch.Generator().manual_seed(0))
    assert _agreement(by_chance, data.part, num_parts) < agreement


def test_the_same_clouds_give_the_same_parts_whatever_the_random_state():
    data = clouds(LAPTOP, count=6, resample=True)
    small = DiscoveryOptions(
        clouds=6, search_clouds=6, split_clouds=6, points=64, starts=2, rounds=1, cuts=False, cycles=2
    )
    torch.manual_seed(1)
    first = discover(data.points, 2, LAPTOP[4], small)
    torch.manual_seed(2)
    second = discover(data.points, 2, LAPTOP[4], small)
    assert torch.equal(first.base, second.base) and torch.equal(first.template.label, second.template.label)


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
        cuts=False,
        cycles=4,
    )
    found = discover(data.points, 3, GLASSES[4], small)
    chain = found.joints.chain
    assert found.state.shape == (8, 2) and {chain.root, *chain.child} == {0, 1, 2}
    assert found.joints.axis[0] @ found.joints.axis[1] >= 0
    assert set(found.template.label.tolist()) == {0, 1, 2}
    assert found.error.isfinite().all()


def test_impossible_numbers_of_parts_are_refused():
    data = clouds(LAPTOP, count=4)
    small = DiscoveryOptions(clouds=4, search_clouds=4, split_clouds=4, points=48, starts=2, rounds=0, min_share=0.3)
    with pytest.raises(RuntimeError, match="do not show 6 parts"):
        discover(data.points, 6, LAPTOP[4], small)


def test_a_category_that_does_not_move_is_refused():
    copies = clouds(LAPTOP, count=1).points.expand(6, -1, -1).contiguous()
    small = DiscoveryOptions(clouds=6, search_clouds=6, split_clouds=6, points=64, starts=2, rounds=0)
    with pytest.raises(DiscoveryError, match="no part that moves in any split of"):
        discover(copies, 2, LAPTOP[4], small)


def test_slabs_lie_at_the_ends_of_a_box():
    box = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 2.0, 3.0])
    for parts in (2, 3):
        labels = slab_cuts(box, parts, torch.Generator().manual_seed(0))
        assert len(labels) == 12
        for label in labels:
            assert label.unique().tolist() == list(range(parts))
            slab = box[label > 0]
            assert 0.09 < len(slab) / len(box) < 0.21
            # Thin along one axis, at one of its ends.
            extent = (slab.amax(dim=0) - slab.amin(dim=0)) / box.amax(dim=0)
            assert extent.min() < 0.3 and (extent > 0.9).sum() == 2


def test_the_points_of_a_small_moving_part_are_restless():
    data = clouds(OVEN, count=16, points=768, resample=True, rotate=False, proportions=0.1, seed=1)
    rows = torch.cat([(data.part == 0).nonzero()[:, 0], (data.part == 1).nonzero()[::4, 0]])
    points, door = data.points[:, rows], data.part[rows] == 1
    half_open = points[data.state[:, 0].sub(1).abs().argmin()]
    smallest, *_ = unrest_cuts(points, half_open, 2, 4, torch.Generator().manual_seed(0))
    assert door.float().mean() < 0.25
    assert door[smallest == 1].float().mean() > 0.9


def test_references_are_typical_of_clusters_and_do_not_depend_on_orientation():
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(20, 100, 3, generator=generator), dim=-1)
    size = torch.cat([torch.linspace(0.9, 1.1, 9), torch.linspace(1.9, 2.1, 9), torch.tensor([0.5, 3.0])])
    small, large = sorted(choose_references(ball * size[:, None, None], 2).tolist())
    assert small in (3, 4, 5) and large in (12, 13, 14)
    spheres = ball * size[:, None, None] * torch.tensor([1.0, 2.0, 3.0])
    turned = spheres @ torch.linalg.qr(torch.randn(20, 3, 3, generator=generator)).Q
    assert torch.equal(choose_references(spheres, 3), choose_references(turned, 3))
    assert choose_references(spheres, 1).shape == (1,)


def test_a_distant_joint_line_is_also_tried_along_the_edges_of_its_part():
    data = clouds(LAPTOP, count=8, points=256)
    across = torch.linalg.cross(data.axis, torch.tensor([[0.3, -0.5, 0.8]]))
    distant = data.pivot + 0.5 * torch.nn.functional.normalize(across, dim=-1)
    joints = JointModel(KinematicChain(2, 0, (0,), (1,)), data.axis, distant, LAPTOP[4])
    template = LabelledTemplate(data.rest, data.part, 2)
    fit = InstanceFit(template, joints, data.base, data.state, torch.Generator().manual_seed(0))
    others = hinged_at_edges(fit)
    distance = [torch.linalg.cross(o.model()[0].pivot - data.pivot, data.axis).norm() for o in others]
    assert len(others) == 4 and min(distance) < 0.06 and max(distance) > 0.2
    assert min(o.error(data.points).mean() for o in others) < fit.error(data.points).mean()


def test_random_splits_have_k_nonempty_parts():
    generator = torch.Generator().manual_seed(0)
    for parts in (2, 3, 4):
        label = random_split(torch.rand(100, 3), parts, generator)
        assert set(label.tolist()) <= set(range(parts)) and label.bincount(minlength=parts).max() < 90
