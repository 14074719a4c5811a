"""Templates are objects where it is known which clouds show the same one."""

import logging
from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import DRAWER, LAPTOP, clouds, true_shape
from twin_objects import with_coarse_slides

from articulate_ssl.discovery import grouped
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.grouped import MOST_CLOUDS, discover_grouped
from articulate_ssl.discovery.one_object.find import OneObject
from articulate_ssl.discovery.one_object.template import as_template
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registrar import SearchingRegistrar
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.ops.chamfer import nearest_index

SMALL = DiscoveryOptions(search_clouds=4, points=128, dense_points=256, references=1, cycles=3, grouped=True)
TWO = replace(SMALL, references=2)
SIZES = (1.0, 1.08)  # of two objects


@pytest.fixture
def no_registration(monkeypatch):
    """Registration that changes nothing and takes no time; the errors it says, one after the other, then zeros."""
    errors: list[float] = []

    def register(self, found: RegisteredShape, targets: torch.Tensor) -> RegisteredShape:
        error = torch.full((len(targets),), errors.pop(0) if errors else 0.0)
        return replace(found, base=found.base[:1].expand(len(targets), 4, 4), error=error)

    monkeypatch.setattr(SearchingRegistrar, "register", register)
    return errors


class World:
    """Two objects of a design in several states each, shuffled, and what would be found of each from its clouds."""

    def __init__(self, design, count: int = 8, points: int = 256) -> None:
        own = [clouds(design, count=count, points=points, resample=True, seed=seed) for seed in (1, 2)]
        order = torch.randperm(2 * count, generator=torch.Generator().manual_seed(0))
        sizes = torch.tensor(SIZES).repeat_interleave(count)[order, None, None]
        self.design, self.part = design, own[0].part
        self.points = torch.cat([data.points for data in own])[order] * sizes
        self.base = torch.cat([data.base for data in own])[order]
        self.state = torch.cat([data.state for data in own])[order]
        self.instance = torch.tensor([7, 3]).repeat_interleave(count)[order]
        self.shape = true_shape(design, own[0])
        self.asked: list[torch.Tensor] = []

    def found(self, points: torch.Tensor, num_parts: int, joint_type: int, part_points: int, seed: int) -> OneObject:
        """In the place of `find_one_object`: the truth."""
        rows = torch.stack([(self.points == cloud).all(dim=(1, 2)).nonzero()[0, 0] for cloud in points])
        self.asked.append(rows)
        size = SIZES[0] if int(self.instance[rows[0]]) == 7 else SIZES[1]
        joints = self.shape.joints
        joints = replace(joints, axis=joints.axis.double(), pivot=joints.pivot.double() * size)
        base, state = self.base[rows].double(), self.state[rows].double()
        base[:, :3, 3] *= size
        state = state * size if self.design is DRAWER else state
        shape = replace(self.shape, points=self.shape.points.double() * size, joints=joints)
        label = shape.label[nearest_index(points.double(), shape.posed(base, state))]
        share = torch.nn.functional.one_hot(label, num_parts).double()
        return OneObject(shape, base, state, label, share, torch.zeros_like(share[..., 0]))


@pytest.mark.parametrize(
    ("design", "points", "least"), [(LAPTOP, 256, 0.95), (DRAWER, 1024, 0.8)], ids=["laptop", "drawer"]
)
def test_an_object_is_registered_to_the_clouds_of_others(design, points, least, monkeypatch):
    with_coarse_slides(monkeypatch)
    world = World(design, points=points)
    monkeypatch.setattr(grouped, "find_one_object", world.found)
    found = discover_grouped(world.points, world.points, world.instance, 2, design[4], SMALL)
    turned = found.base[:, :3, :3].mT @ world.base[:, :3, :3]
    apart = roma.rotmat_geodesic_distance(turned[:, None], turned).rad2deg().median(dim=1).values
    right = apart < 20
    assert apart.median() < 5 and right.float().mean() > 0.8
    state = torch.stack([found.state[:, 0], world.state[:, 0]])[:, right]
    assert torch.corrcoef(state)[0, 1].abs() > least
    axis = found.base[:, :3, :3] @ found.shape.joints.axis[0]
    truth = world.base[:, :3, :3] @ world.shape.joints.axis[0]
    assert (axis * truth).sum(dim=1).abs().median() > 0.99
    assert len(found.error) == len(world.points) and found.shape.points.shape == (256, 3)


def test_objects_are_looked_for_in_all_of_their_clouds_and_no_other(monkeypatch, no_registration):
    world = World(LAPTOP)
    monkeypatch.setattr(grouped, "find_one_object", world.found)
    discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], TWO)
    assert [world.instance[rows].unique().tolist() for rows in world.asked] == [[3], [7]]
    assert [len(rows.unique()) for rows in world.asked] == [8, 8]


@pytest.mark.parametrize(("errors", "size"), [([0.5, 1.0], SIZES[1]), ([1.0, 0.5], SIZES[0])])
def test_the_object_that_explains_most_stays(errors, size, monkeypatch, no_registration):
    world = World(LAPTOP)
    monkeypatch.setattr(grouped, "find_one_object", world.found)
    no_registration += errors  # of object 3, the larger one, then of object 7
    found = discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], TWO)
    pivot = found.shape.joints.pivot[0] - found.shape.points.mean(dim=0)
    own = as_template(world.found(world.points[world.instance == (3 if size > 1 else 7)], 2, 0, 0, 0), 256).shape
    torch.testing.assert_close(pivot, own.joints.pivot[0] - own.points.mean(dim=0))


@pytest.mark.parametrize(
    ("off", "chosen_object"),  # so many of 1,000 points of objects 3 and 7; object 3 fits other clouds better
    [((50, 20), 7), ((50, 30), 3), ((9, 1), 3), ((11, 1), 7)],
    ids=["less than half as well", "nearly as well", "less well, but well", "not well"],
)
def test_an_object_that_is_understood_less_well_is_no_template(off, chosen_object, monkeypatch, no_registration):
    world = World(LAPTOP)

    def found(points, *rest):
        one = world.found(points, *rest)
        misfit = torch.zeros(1000)
        misfit[: off[len(world.asked) - 1]] = 0.02
        return replace(one, misfit=misfit.expand(len(points), 1000))

    monkeypatch.setattr(grouped, "find_one_object", found)
    no_registration += [0.5, 1.0]
    chosen = discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], TWO)
    own = as_template(world.found(world.points[world.instance == chosen_object], 2, 0, 0, 0), 256).shape
    pivot = chosen.shape.joints.pivot[0] - chosen.shape.points.mean(dim=0)
    torch.testing.assert_close(pivot, own.joints.pivot[0] - own.points.mean(dim=0))


def test_an_object_that_fails_is_left_out_with_a_word(monkeypatch, caplog, no_registration):
    world = World(LAPTOP)

    def found(points, *rest):
        one = world.found(points, *rest)
        if len(world.asked) == 1:
            raise DiscoveryError("it was moving")
        return one

    monkeypatch.setattr(grouped, "find_one_object", found)
    with caplog.at_level(logging.WARNING, "articulate_ssl"):
        found = discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], TWO)
    assert len(found.base) == 16
    assert [record.message for record in caplog.records] == ["part discovery leaves object 1 of 2 out: it was moving"]


def test_where_no_object_is_understood_it_is_said(monkeypatch, caplog):
    world = World(LAPTOP)

    def found(*arguments):
        one = world.found(*arguments)
        return replace(one, misfit=torch.full_like(one.misfit, 0.02))

    monkeypatch.setattr(grouped, "find_one_object", found)
    with pytest.raises(DiscoveryError, match="parts of none of 2 objects"):
        discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], TWO)
    assert [record.message.count("100% of the points") for record in caplog.records] == [1, 1]


def test_objects_with_few_clouds_are_no_templates(monkeypatch, no_registration):
    world = World(LAPTOP)
    instance = world.instance.clone()
    instance[(instance == 3).nonzero()[0]] = 5
    monkeypatch.setattr(grouped, "find_one_object", world.found)
    discover_grouped(world.points, world.points, instance, 2, LAPTOP[4], TWO)
    assert [instance[rows].unique().tolist() for rows in world.asked] == [[7]]
    with pytest.raises(DiscoveryError, match=r"none has more than 1\. Make more states .*--states 10.*one folder"):
        discover_grouped(world.points, world.points, torch.arange(16), 2, LAPTOP[4], TWO)


def test_of_many_clouds_of_an_object_some_are_looked_at(monkeypatch, no_registration):
    world = World(LAPTOP, count=20, points=128)
    monkeypatch.setattr(grouped, "find_one_object", world.found)
    discover_grouped(world.points, world.points, world.instance, 2, LAPTOP[4], SMALL)
    assert len(world.asked[0].unique()) == MOST_CLOUDS


def test_clouds_of_what_slides_are_labelled_by_all_objects(monkeypatch):
    """In the numbers of the template that stays, also where objects number their parts otherwise."""
    with_coarse_slides(monkeypatch)
    world = World(DRAWER, points=1024)

    def found(points, *rest):
        one = world.found(points, *rest)
        if len(world.asked) == 1:
            return one
        chain = KinematicChain(2, 1, (1,), (0,))
        shape = replace(one.shape, label=1 - one.shape.label, joints=replace(one.shape.joints, chain=chain))
        return replace(one, shape=shape, label=1 - one.label, probability=one.probability.flip(-1))

    monkeypatch.setattr(grouped, "find_one_object", found)
    result = discover_grouped(world.points, world.points, world.instance, 2, DRAWER[4], replace(SMALL, objects=2))
    assert len(world.asked) == 2 and result.labelled.points.shape == (16, 1024, 3)
    truth = world.part.expand(16, -1)
    root = result.shape.joints.chain.root
    for part in (result.point_part, result.labelled.part):
        assert ((part != root).long() == truth).float().mean() > 0.9
    assert result.turned(torch.eye(3)).labelled is None  # they stand as canonical space did
