"""Parts of objects get common names by the order in which they repeat, whatever each object calls them."""

from itertools import permutations

import pytest
import torch

from articulate_ssl.discovery.named_alike import ObjectParts, named_alike
from articulate_ssl.geometry.rotation_group import rotation_group

# Seen from the front, to which z points: x right, y up. What is read first comes first, lines from top to bottom.
STACK = ((0.0, 0.4), (0.0, 0.1), (0.0, -0.3))
ROW = ((-0.5, 0.3), (0.05, 0.31), (0.5, 0.29))
# One across, then two above each other beside it: around the corner from either side.
CORNER = ((-0.3, 0.4), (0.3, 0.4), (0.3, 0.0))
MIRRORED = tuple((-x, y) for x, y in CORNER)


def _object(places, own: list[int], seed: int, root_at: float = 0.0) -> ObjectParts:
    """Of which part k is the body, if own[k] is 0, or lies at places[own[k] - 1]; drawers stick out to the front."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.tensor([(root_at, 0.0, 0.0), *((x, y, 0.3) for x, y in places)])
    label = torch.arange(400).expand(3, 400) % 4
    spread = torch.tensor([[0.5, 0.5, 0.4], *[[0.05, 0.05, 0.4]] * 3])
    common = torch.tensor(own)[label]
    boxes = centers[common] + spread[common] * (2 * torch.rand(3, 400, 3, generator=generator) - 1)
    return ObjectParts(boxes, label, own.index(0))


def _many() -> tuple[list[ObjectParts], list[list[int]]]:
    orders = [list(order) for order in permutations(range(4))]
    kinds = [STACK, STACK, ROW, STACK, CORNER, STACK, MIRRORED]
    return [_object(kinds[i % 7], own, seed=i) for i, own in enumerate(orders)], orders


def test_parts_of_all_kinds_are_named_in_one_order():
    objects, orders = _many()
    names = [
        tuple(name[torch.tensor(own).argsort()].tolist())
        for name, own in zip(named_alike(objects, 4), orders, strict=True)
    ]
    assert set(names) in ({(0, 1, 2, 3)}, {(0, 3, 2, 1)})


@pytest.mark.parametrize("turn", range(24))
def test_the_order_does_not_depend_on_how_all_stand(turn):
    """In any frame of the collection all are read from the same end, or all from the other."""
    rotation = rotation_group(24).elements[turn]
    objects, orders = _many()
    objects = [one._replace(boxes=one.boxes @ rotation.to(one.boxes).T) for one in objects]
    names = [
        tuple(name[torch.tensor(own).argsort()].tolist())
        for name, own in zip(named_alike(objects, 4), orders, strict=True)
    ]
    assert set(names) in ({(0, 1, 2, 3)}, {(0, 3, 2, 1)})


def test_in_the_mirror_rows_are_read_from_the_other_end():
    """So handedness counts: what stands in a mirror is another collection."""
    objects, orders = _many()
    objects = [one._replace(boxes=one.boxes * torch.tensor([-1.0, 1, 1])) for one in objects]
    names = [
        tuple(name[torch.tensor(own).argsort()].tolist())
        for name, own in zip(named_alike(objects, 4), orders, strict=True)
    ]
    assert {names[0], names[2]} == {(0, 1, 2, 3), (0, 3, 2, 1)}  # a chest and a row


def test_roots_have_one_name_wherever_they_lie():
    objects = [_object(STACK, [0, 1, 2, 3], 0), _object(STACK, [2, 0, 1, 3], 1, root_at=0.3)]
    for name, root in zip(named_alike(objects, 4), (0, 1), strict=True):
        assert int(name[root]) == 0 and sorted(name.tolist()) == [0, 1, 2, 3]


def test_a_single_part_needs_no_order():
    one = _object(STACK, [0, 1, 2, 3], 0)
    pair = one._replace(label=(one.label > 0).long())
    assert named_alike([pair, pair], 2)[0].tolist() == [0, 1]
