"""Clouds whose object was placed otherwise than in most are found, and placed as those."""

from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import GLASSES, LAPTOP, OVEN, Clouds, clouds, true_shape

from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.find import _asked_again, refined
from articulate_ssl.discovery.one_object.stand_alike import nearest_ways, placed_alike, sought_alike
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.shape.joints import Joints

_OTHERWISE = [1, 4, 6]
# Two plates alike, but for what is below one of them, hinged between them.
_PLATES = (
    [((0, 0, 0), (0.5, 0.7, 0.04)), ((0, 0, 0.04), (0.5, 0.7, 0.08))],
    (0,),
    [((0, 1, 0), (0, 0, 0.04))],
    *LAPTOP[3:],
)


def _with_a_ledge(data: Clouds, height: float) -> Clouds:
    """On the body, at one of its edges, so that it is not the same back to front."""
    generator = torch.Generator().manual_seed(0)
    ledge = torch.rand(9, 256, 3, generator=generator) * torch.tensor([0.1, 0.6, 0.1]) + torch.tensor([0, 0, height])
    points = torch.cat([data.points, transform_points(data.base, ledge[:8])], dim=1)
    rest, part = torch.cat([data.rest, ledge[8]]), torch.cat([data.part, torch.zeros(256, dtype=torch.long)])
    order = torch.randperm(len(part), generator=generator)
    return data._replace(points=points[:, order], rest=rest[order], part=part[order])


class _World:
    """Of 8 clouds: where the object is, the clouds as surfaces, and the object."""

    def __init__(self, design, ledge: float):
        data = _with_a_ledge(clouds(design, count=8, points=1792, resample=True, seed=1), ledge)
        child = tuple(range(1, len(design[0])))
        joints = Joints(KinematicChain(len(child) + 1, 0, design[1], child), data.axis, data.pivot, design[4])
        joints = replace(joints, axis=data.axis.double(), pivot=data.pivot.double())
        self.truth = Placed(joints, data.base.double(), data.state.double())
        self.surfaces = [Surface.of(cloud) for cloud in data.points.double().numpy()]
        self.shape = replace(true_shape(design, data), joints=joints)


@pytest.fixture(scope="module")
def oven():
    return _World(OVEN, 0.5)


@pytest.fixture(scope="module")
def laptop():
    return _World(_PLATES, -0.1)


def _placed(placed: Placed, base: torch.Tensor) -> Placed:
    wrong = placed.base.clone()
    wrong[_OTHERWISE] = base[_OTHERWISE]
    return replace(placed, base=wrong)


def _back_to_front(placed: Placed) -> Placed:
    """An oven's box about its own middle, on which the door is then behind."""
    middle = torch.tensor([0.25, 0.3, 0.25]).double()
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    return _placed(placed, placed.base @ se3(turn, middle - turn @ middle))


def _exchanged(placed: Placed) -> Placed:
    """A laptop's base lies where its lid is, and the lid where the base is: the same states say so."""
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    onto = se3(over, torch.tensor([0.0, 0.7, 0.08]).double())
    return _placed(placed, placed.pose[:, 1] @ onto)


def _turned(placed: Placed, truth: Placed) -> torch.Tensor:
    """Degrees by which bases of other clouds are turned, as seen from the first cloud's."""
    own = [(p.base[0] @ invert_se3(p.base))[:, :3, :3] for p in (placed, truth)]
    return roma.rotmat_geodesic_distance(*own).rad2deg()


@pytest.mark.parametrize(("name", "otherwise"), [("oven", _back_to_front), ("laptop", _exchanged)])
def test_bodies_are_placed_as_most_are(name, otherwise, request):
    world = request.getfixturevalue(name)
    wrong = otherwise(world.truth)
    assert (_turned(wrong, world.truth) > 90).nonzero()[:, 0].tolist() == _OTHERWISE
    found = placed_alike(wrong, world.shape, world.surfaces)
    assert _turned(found, world.truth).max() < 5
    torch.testing.assert_close(found.state, wrong.state)


def test_where_all_are_alike_nothing_changes(oven):
    assert placed_alike(oven.truth, oven.shape, oven.surfaces) is oven.truth


def test_the_object_is_exact_again(oven):
    """Also fused from clouds that are placed otherwise, and with doors that turned as they could."""
    lost = refined(oven.surfaces, _back_to_front(oven.truth), 512)
    found = _asked_again(lost, oven.surfaces, 512)
    assert found.misfit.mean() < lost.misfit.mean()
    turned = found.state[:, 0] - found.state[0, 0], oven.truth.state[:, 0] - oven.truth.state[0, 0]
    assert min((turned[0] - turned[1]).abs().max(), (turned[0] + turned[1]).abs().max()).rad2deg() < 1


def test_glasses_that_lie_on_their_other_side_in_one_cloud_do_so_no_more():
    """There the temples are each other's, and so are their states."""
    world = _World(GLASSES, 0.5)
    middle = torch.tensor([0.0, 0.0, 0.1]).double()
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    base, state = world.truth.base.clone(), world.truth.state.clone()
    base[3], state[3] = base[3] @ se3(turn, middle - turn @ middle), state[3].flip(0)
    wrong = replace(world.truth, base=base, state=state)
    lost = refined(world.surfaces, wrong, 512)
    found = sought_alike(
        Placed(replace(lost.shape.joints, limits=None), lost.base, lost.state), lost.shape, world.surfaces
    )
    assert _turned(lost, world.truth)[3] > 150 and _turned(found, world.truth).max() < 10
    assert (found.state - world.truth.state).abs().amax(dim=1)[3] < 0.15
    assert sought_alike(world.truth, world.shape, world.surfaces) is world.truth
    again = _asked_again(lost, world.surfaces, 512)
    assert again.misfit.mean() < lost.misfit.mean() and _turned(again, world.truth).max() < 2


def _apart(kind: list[int], off: float = 0.0):
    """Of clouds of two kinds, which one way brings onto each other, but for what it is off."""

    def apart(one: int, way: int, other: int, its: int) -> float:
        alike = kind[one] ^ way == kind[other] ^ its
        return (0.5 if alike else 0.9) + off * (way != its)

    return apart


def _kinds(kind: list[int], chosen: list[int]) -> set[int]:
    return {own ^ way for own, way in zip(kind, chosen, strict=True)}


@pytest.mark.parametrize("kind", [[0, 1, 0, 0, 1, 0, 0], [0, 1, 1, 0, 1, 0, 0, 1], [0] * 6])
@pytest.mark.parametrize("off", [0.0, 0.15])
def test_clouds_of_two_kinds_become_one(kind, off):
    """Also where as many are of either, and each is nearer to its own as it is than the way is exact."""
    chosen = nearest_ways(_apart(kind, off), 2, len(kind))
    assert len(_kinds(kind, chosen)) == 1
    assert sum(chosen) <= len(kind) / 2


def test_a_way_that_makes_nothing_nearer_is_not_taken():
    assert nearest_ways(lambda one, way, other, its: 0.5 + 0.1 * (way != 0), 3, 6) == [0] * 6
