"""A network says which part points of views are of, beside similar views; it comes with the views that taught it."""

import roma
import torch
from articulated_objects import CHEST, clouds
from tiny import tiny_module

from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference import view_search
from articulate_ssl.inference.candidates import angle_to
from articulate_ssl.inference.front_ends import FrontEnds
from articulate_ssl.inference.view_parts import ViewParts
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.inference.votes import Votes
from articulate_ssl.training import frame_lessons, part_lessons
from articulate_ssl.training.frame_lessons import learn_part_frames
from articulate_ssl.training.view_lessons import teach_view_parts


def _standing(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Chests of different proportions that stand alike; whole ones stand for views of them."""
    data = clouds(CHEST, count=count, points=300, resample=True, rotate=False, seed=seed, proportions=0.2)
    return data.points, data.part.expand(count, -1)


def _undecided(points: torch.Tensor) -> Votes:
    return Votes(points, torch.full((*points.shape[:2], 3), 1 / 3))


def test_unseen_views_have_their_parts(monkeypatch):
    monkeypatch.setattr(part_lessons, "_STEPS", 60)
    network = teach_view_parts(*_standing(30, seed=0), 3)
    assert not any(p.requires_grad for p in network.parameters())
    points, part = _standing(4, seed=1)
    still = torch.eye(3).expand(4, 3, 3)
    said = network.beside(_undecided(points), points, still)
    assert torch.equal(said.points, points)
    torch.testing.assert_close(said.share.sum(dim=-1), torch.ones(4, 300))
    assert (said.share.argmax(dim=-1) == part).float().mean() > 0.9
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0])).expand(4, 3, 3)
    turned = network.beside(_undecided(points), points @ over, over)  # seen so, and known to be
    torch.testing.assert_close(turned.share, said.share, atol=1e-4, rtol=0)
    wrong = network.beside(_undecided(points), points, over)
    assert (wrong.share.argmax(dim=-1) == part).float().mean() < 0.8


def test_similar_views_have_a_say():
    points, _ = _standing(2, seed=2)
    network = ViewParts(3).eval()
    certain = Votes(points, torch.eye(3)[torch.full((2, 300), 2)])
    assert (network.beside(certain, points, torch.eye(3).expand(2, 3, 3)).share.argmax(dim=-1) == 2).all()


def test_networks_are_saved_with_views():
    search = ViewSearch(3)
    assert search.parts is None
    search.parts = ViewParts(3)
    other = ViewSearch(3)
    other.load_state_dict(search.state_dict())
    assert torch.equal(other.parts.point[0].weight, search.parts.point[0].weight)
    assert not other.parts.point[0].weight.requires_grad
    search.forget()
    assert search.parts is None
    other.load_state_dict(ViewSearch(3).state_dict())
    assert other.parts is None


def test_views_that_are_square_teach_it_and_predictions_ask_it(monkeypatch):
    monkeypatch.setattr(part_lessons, "_STEPS", 2)
    module = tiny_module(num_parts=3, joint_type="prismatic").eval()
    data = clouds(CHEST, count=8, points=2048, resample=True)
    part = data.part.expand(8, -1)
    module.view_search.learn(data.points, data.base, data.state, part)
    standing = module.view_search.standing
    assert (standing - transform_points(torch.linalg.inv(data.base), data.points)[:, :256]).std(dim=1).max() < 0.01
    truth = module.articulated.category_at(data.base[:, None], data.state[:, None])
    monkeypatch.setattr(frame_lessons, "explain", lambda *_: truth)
    learn_part_frames(module, data.points)
    assert module.object_frame.learnt and module.estimator.reads_dense
    assert isinstance(module.view_search.parts, ViewParts)
    asked = []
    monkeypatch.setattr(
        ViewParts,
        "beside",
        lambda self, votes, views, turn: asked.append((views, turn)) or Votes(views, votes.at(views)),
    )
    found = module.estimator.predict(data.points[:, :256], 48, refine=True, dense=data.points)
    ((views, turn),) = asked
    assert torch.equal(views, data.points) and found.dense_part_id.shape == (8, 2048)
    assert angle_to((found.base_pose[:, :3, :3] @ module.object_frame.axes).mT[:, None], turn).max() < 1e-3
    monkeypatch.setattr(frame_lessons, "explain", lambda *_: truth.at(truth.base.flip(0), truth.state))
    learn_part_frames(module, data.points)
    assert not module.object_frame.learnt and module.view_search.parts is None


class _LooksRight(torch.nn.Module):
    """In place of a network of turns: sure of those that are given."""

    def __init__(self, turn: torch.Tensor) -> None:
        super().__init__()
        self.turn, self.temperature = turn, torch.tensor(1.0)

    def looks_right(self, frames: torch.Tensor, dense: torch.Tensor) -> torch.Tensor:
        return 9.0 * (roma.rotmat_geodesic_distance(frames, self.turn[:, None].expand_as(frames)) < 0.5).to(frames)


def test_a_network_of_turns_overrules_the_search_and_fronts_place_drawers(monkeypatch):
    module = tiny_module(num_parts=3, joint_type="prismatic").eval()
    data = clouds(CHEST, count=4, points=2048, resample=True)
    over = se3(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.zeros(3))
    # Views of objects as they are, and of some that are turned another way.
    base, part = torch.cat([data.base, data.base @ over]), data.part.expand(8, -1)
    module.view_search.learn(data.points.repeat(2, 1, 1), base, data.state.repeat(2, 1), part)
    module.object_frame.known.fill_(True)
    monkeypatch.setattr(view_search, "_ALIKE", 1)
    for truth in (data.base, data.base @ over):
        module.object_frame.surface = _LooksRight(truth[:, :3, :3])
        found = module.estimator.predict(data.points[:, :256], 48, refine=True, dense=data.points)
        assert roma.rotmat_geodesic_distance(found.base_pose[:, :3, :3], truth[:, :3, :3]).rad2deg().max() < 20
        assert (found.margin > 0.9).all()
    module.object_frame.surface, placed = None, []
    module.front_ends.end.fill_(1.0)
    monkeypatch.setattr(FrontEnds, "placed", lambda self, one, frame, category, *seen: placed.append(seen) or one)
    found = module.estimator.predict(data.points[:, :256], 48, refine=True, dense=data.points)
    ((views, labels),) = placed
    assert torch.equal(views, data.points) and torch.equal(labels, found.dense_part_id)
    module.estimator.predict(data.points[:, :256], 48, refine=False, dense=data.points)
    module.object_frame.forget()
    module.estimator.predict(data.points[:, :256], 48, refine=True, dense=data.points)
    assert len(placed) == 1
