"""Drawers are where their fronts are; which ends are fronts, states that were fitted say."""

from dataclasses import replace

import roma
import torch
from articulated_objects import CHEST, Clouds, clouds, true_shape
from true_category import Category

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.front_ends import FrontEnds
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.shape.articulated_shape import ArticulatedShape

# Of canonical space, in which no axis of the object is one of coordinates.
CANONICAL = roma.rotvec_to_rotmat(torch.tensor([0.4, -0.7, 0.3]))


def _frame() -> ObjectFrame:
    frame = ObjectFrame()
    frame.axes.copy_(CANONICAL)
    frame.known.fill_(True)
    return frame


def _category(data: Clouds) -> ArticulatedShape:
    shape = true_shape(CHEST, data)
    joints = replace(shape.joints, axis=shape.joints.axis @ CANONICAL.mT, pivot=shape.joints.pivot @ CANONICAL.mT)
    points = torch.cat([shape.part(part)[:400] for part in range(3)]) @ CANONICAL.mT
    return ArticulatedShape(points, torch.arange(3).repeat_interleave(400), joints)


def _views(count: int, seed: int = 0) -> tuple[Clouds, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Objects; views of their drawers' fronts, more or less deep; which parts that is of; how objects are turned."""
    data = clouds(CHEST, count=count, points=1500, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    views = data.points.clone()
    for view in views:
        seen = data.rest[:, 0] > 0.05 + 0.3 * torch.rand(1, generator=generator)
        for part in (1, 2):
            shown, hidden = (((data.part == part) & some).nonzero()[:, 0] for some in (seen, ~seen))
            view[hidden] = view[shown[torch.randint(len(shown), hidden.shape, generator=generator)]]
    return data, views, data.part.expand(count, -1), data.base[:, :3, :3] @ CANONICAL.mT


def _learnt(sign: float = 1.0) -> tuple[FrontEnds, torch.Tensor]:
    data, views, part, turn = _views(40)
    noise = 0.05 * torch.randn(data.state.shape, generator=torch.Generator().manual_seed(0))
    ends, category = FrontEnds(2), _category(data)
    category = replace(category, joints=replace(category.joints, axis=sign * category.joints.axis))
    return ends, ends.learn(_frame(), category, turn, views, part, sign * (data.state + noise))


def test_ends_are_learnt_from_states_that_are_off():
    for sign in (1.0, -1.0):  # whichever way axes point
        ends, together = _learnt(sign)
        assert ends.learnt and ends.end.tolist() == [sign, sign] and together.min() > 0.7


def test_states_that_go_with_neither_end_teach_nothing():
    data, views, part, turn = _views(40)
    ends, _ = _learnt()
    ends.learn(_frame(), _category(data), turn, views, part, data.state.flip(0))
    assert not ends.learnt


def test_slides_that_are_not_along_the_frame_teach_nothing():
    data, views, part, turn = _views(8)
    frame, ends = _frame(), FrontEnds(2)
    frame.axes.copy_(CANONICAL @ roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.6])))
    assert not ends.learn(frame, _category(data), turn, views, part, data.state).any()
    assert not ends.learnt


def test_drawers_are_where_their_fronts_are():
    ends, _ = _learnt()
    data, views, part, turn = _views(6, seed=3)
    category = _category(data)
    start = se3(turn, data.base[:, :3, 3])[:, None]
    one = Category(category).category_at(start, data.state[:, None] + 0.12)
    with torch.inference_mode():
        found = ends.placed(one, _frame(), category, views, part)
    torch.testing.assert_close(found.state[:, 0], data.state, atol=0.03, rtol=0)
    torch.testing.assert_close(found.base[..., :3, :3], start[..., :3, :3])
    assert nearest_distance(data.points, found.posed()[:, 0].flatten(1, 2)).mean() < 0.04
    # Where no point is held to be of the body, nothing says how far out drawers are.
    unseen = part.clone()
    unseen[0] = unseen[0].clamp(min=1)
    found = ends.placed(one, _frame(), category, views, unseen)
    assert torch.equal(found.state[0], one.state[0]) and not torch.equal(found.state[1], one.state[1])


def test_weights_from_before_ends_were_learnt_know_none():
    ends, _ = _learnt()
    other = FrontEnds(2)
    other.load_state_dict(ends.state_dict())
    assert other.learnt
    other = FrontEnds(2)
    other.load_state_dict({})
    assert not other.learnt
    ends.forget()
    assert not ends.learnt
