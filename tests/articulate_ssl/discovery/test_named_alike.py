"""Parts of objects get common names by where they lie, whatever each object calls them."""

import torch

from articulate_ssl.discovery.named_alike import ObjectParts, named_alike

CENTERS = torch.tensor([[0.0, 0, -0.4], [0.2, 0, -0.1], [0.2, 0, 0.1], [0.2, 0, 0.4]])  # a body, three drawers


def _object(own: list[int], generator: torch.Generator, noise: float = 0.03) -> ObjectParts:
    """Of which part k is the common part own[k]."""
    label = torch.arange(200).expand(3, 200) % 4
    centers = CENTERS + noise * torch.randn(4, 3, generator=generator)
    boxes = centers[torch.tensor(own)][label] + 0.05 * torch.randn(3, 200, 3, generator=generator)
    return ObjectParts(boxes, label, own.index(0))


def test_parts_are_named_by_place():
    generator = torch.Generator().manual_seed(0)
    orders = [[1, 3, 0, 2], [0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]]
    names = named_alike([_object(own, generator) for own in orders], 4)
    assert torch.equal(names[0], torch.arange(4))  # as the first one calls them
    first = torch.tensor(orders[0])
    for own, name in zip(orders, names, strict=True):
        assert torch.equal(first[name], torch.tensor(own))


def test_an_unusual_first_object_does_not_name_the_others_wrongly():
    """The drawers of a desk lie beside each other: all others agree with each other all the same."""
    generator = torch.Generator().manual_seed(1)
    own = [0, 1, 2, 3]
    desk = _object(own, generator, noise=0)
    desk = desk._replace(
        boxes=desk.boxes + torch.tensor([[0.0, 0, 0], [0, -0.3, 0.1], [0, 0, 0], [0, 0.3, -0.2]])[desk.label]
    )
    names = named_alike([desk, *(_object(order, generator) for order in ([0, 1, 2, 3], [0, 3, 2, 1], [0, 2, 1, 3]))], 4)
    common = [
        name[torch.tensor(order).argsort()]
        for name, order in zip(names[1:], ([0, 1, 2, 3], [0, 3, 2, 1], [0, 2, 1, 3]), strict=True)
    ]
    assert torch.equal(common[0], common[1]) and torch.equal(common[0], common[2])


def test_roots_have_one_name_wherever_they_lie():
    generator = torch.Generator().manual_seed(2)
    usual, other = (_object([0, 1, 2, 3], generator) for _ in range(2))
    names = named_alike([usual, other._replace(root=1)], 4)
    assert int(names[1][1]) == 0 and sorted(names[1].tolist()) == [0, 1, 2, 3]
