"""A box that lies on its side stands up: its parts and joint stay where they are, its frame turns."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import roma
import torch
from boxes_with_doors import HINGE, PIVOT, QUARTER, ZERO, TopIsUp, box_parts, box_shape, box_sides, lying_boxes
from tiny import POINTS, tiny_module

from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.hinge_sides import BODY_SIZE, DOOR_SIZE, TURNS, Bodies, HingeSides, turned_about
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.surface_decision import LOOKS, SIZE, SurfaceDecision
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.training import hinge_lessons
from articulate_ssl.training.hinge_lessons import learn_hinge_sides

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


def test_faces_say_when_the_door_is_closed():
    """To a fraction of a degree, though the joint is believed to be tilted; boxes about points then are off."""
    shape = box_shape()
    tilt = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.1, -0.1]))
    believed = replace(shape, joints=replace(shape.joints, axis=HINGE[None] @ tilt.mT))
    frames = _faces()
    sides, by_boxes = HingeSides(), HingeSides()
    sides.measure(believed, torch.tensor([[ZERO + 0.9, ZERO + 1.8]]), frames)
    by_boxes.measure(believed, torch.tensor([[ZERO + 0.9, ZERO + 1.8]]))
    assert abs(float(sides.closed) - ZERO) < 0.005
    assert abs(float(by_boxes.closed) - ZERO) > 0.005
    torch.testing.assert_close(sides.axes, torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), atol=1e-5, rtol=0)


def _faces() -> PartFrames:
    """How the faces of box and door lie."""
    frames = PartFrames(2)
    frames.flat.fill_(True)
    frames.measured.fill_(True)
    frames.direction.copy_(HINGE)
    frames.axes[0] = torch.eye(3)[:, [2, 0, 1]]
    frames.axes[1] = roma.rotvec_to_rotmat(-ZERO * HINGE)
    return frames


@pytest.mark.parametrize("every", [3, 10])
def test_a_door_that_holds_pieces_of_the_body_is_closed_where_it_is_near_it(every):
    """Wide open, these pieces are where the body is, and the whole is smaller than with the door closed."""
    shape = box_shape()
    label = shape.label.clone()
    label[((label == 0) & (shape.points[:, 1] > 0.25)).nonzero()[::every]] = 1  # beside the hinge
    sides = HingeSides()
    sides.measure(replace(shape, label=label), torch.tensor([[ZERO + 0.9, ZERO + 1.8]]), _faces())
    assert float(sides.closed) == pytest.approx(ZERO, abs=0.01)


def _posed(prediction: Prediction) -> torch.Tensor:
    return transform_points(prediction.part_pose, prediction.part_shape)


def _holds(prediction: Prediction) -> None:
    """Base, canonical joint and state pose the parts, and the joint in camera space is the canonical one."""
    base, line = prediction.base_pose, (prediction.canonical_axis, prediction.canonical_pivot)
    motion = screw_motion(*line, prediction.joint_state, REVOLUTE)[:, 0]
    pose = torch.stack([base, base @ motion], dim=1)
    whole = transform_points(pose, prediction.part_shape + prediction.assembly[:, :, None])
    torch.testing.assert_close(whole, _posed(prediction), atol=1e-5, rtol=0)
    axis = (base[:, None, :3, :3] @ prediction.canonical_axis[..., None]).squeeze(-1)
    torch.testing.assert_close(axis, prediction.joint_axis, atol=1e-5, rtol=0)
    torch.testing.assert_close(transform_points(base, line[1]), prediction.joint_pivot, atol=1e-5, rtol=0)


def _same_in_camera_space(one: Prediction, other: Prediction) -> None:
    torch.testing.assert_close(_posed(one), _posed(other), atol=1e-5, rtol=0)
    for name in ("joint_axis", "joint_pivot", "part_id"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name))


def test_the_closed_door_is_square_to_the_body_and_near_it():
    sides = box_sides()
    assert float(sides.closed) == pytest.approx(ZERO, abs=0.02)
    torch.testing.assert_close(sides.axes[:, 2], torch.tensor([0.0, 0.0, 1.0]), atol=0.03, rtol=0)
    torch.testing.assert_close(sides.door, torch.tensor([0.0, 0.0, -0.26]), atol=0.02, rtol=0)
    assert float(torch.linalg.det(sides.axes)) == pytest.approx(1, abs=1e-4)


def test_states_count_from_the_closed_door():
    prediction, _, _ = lying_boxes([0, 1, 2])
    counted = box_sides().counted_from_closed(prediction)
    _same_in_camera_space(counted, prediction)
    _holds(counted)
    torch.testing.assert_close(counted.joint_state, torch.full((3, 1), 1.2), atol=0.02, rtol=0)
    closed = box_sides().counted_from_closed(lying_boxes([0], opened=0.0)[0])
    turned = roma.rotmat_geodesic_distance(closed.part_pose[:, 0, :3, :3], closed.part_pose[:, 1, :3, :3])
    assert float(turned) < 0.02


def test_a_turned_frame_leaves_everything_where_it_is():
    prediction, _, _ = lying_boxes([0, 1, 2, 3])
    normal = prediction.base_pose[:, :3, 2]
    turned = turned_about(prediction, normal, torch.arange(4))
    _same_in_camera_space(turned, prediction)
    _holds(turned)
    angle = roma.rotmat_geodesic_distance(turned.base_pose[:, :3, :3], prediction.base_pose[:, :3, :3])
    torch.testing.assert_close(angle, torch.tensor([0, QUARTER, math.pi, QUARTER]), atol=2e-3, rtol=0)
    assert torch.equal(turned.joint_state, prediction.joint_state)


def test_a_lying_object_stands_up():
    prediction, dense, true = lying_boxes([0, 1, 2, 3])
    sides = box_sides()
    sides.surface = TopIsUp()
    decided, _ = sides.decided(sides.counted_from_closed(prediction), dense)
    _same_in_camera_space(decided, prediction)
    _holds(decided)
    off = roma.rotmat_geodesic_distance(decided.base_pose[:, :3, :3], true).rad2deg()
    assert off.max() < 2
    # Where odds are not to be believed to the letter, they are the same way, less sure.
    sides.surface.temperature.fill_(1e6)
    unsure, _ = sides.decided(sides.counted_from_closed(prediction), dense)
    torch.testing.assert_close(unsure.base_pose, decided.base_pose)
    assert (unsure.margin < decided.margin).all()
    # Rarely seen sides take more to be believed.
    sides.log_prior.copy_(torch.tensor([0.0, -1e3, -1e3, -1e3]))
    kept, _ = sides.decided(sides.counted_from_closed(prediction), dense)
    torch.testing.assert_close(kept.base_pose, prediction.base_pose)


@pytest.mark.parametrize(("doors", "likelier", "turns"), [(False, 2.1, 1), (False, 1.9, 0), (True, 0.1, 2)])
def test_what_is_undecided_of_a_body_stays_and_doors_are_believed(doors, likelier, turns):
    prediction, dense, _ = lying_boxes([2] if doors else [1], knob=doors)
    sides = box_sides()
    sides.doors.fill_(doors)
    sides.closed.zero_()
    sides.surface = TopIsUp(up=0, size=DOOR_SIZE) if doors else TopIsUp()
    looks = sides.looks_right(sides.bodies(prediction, dense, (dense,)))[0]
    sides.log_prior.fill_(-1e6)
    sides.log_prior[:2] = likelier * torch.arange(2.0) - looks[:2]
    decided, quarters = sides.decided(prediction, dense)
    assert quarters.tolist() == [turns]
    assert float(decided.margin) == pytest.approx(math.tanh(likelier / 2) if turns else 0, abs=1e-2)
    _same_in_camera_space(decided, prediction)


@pytest.mark.parametrize("opened", [0.3, 1.2, 2.2])
def test_upside_down_is_told_by_doors_too(opened):
    prediction, dense, true = lying_boxes([0, 2, 2], opened, knob=True)
    sides = box_sides()
    sides.doors.fill_(True)
    sides.closed.zero_()
    sides.surface = TopIsUp(up=0, size=DOOR_SIZE)
    decided, _ = sides.decided(sides.counted_from_closed(prediction), dense)
    _same_in_camera_space(decided, prediction)
    off = roma.rotmat_geodesic_distance(decided.base_pose[:, :3, :3], true).rad2deg()
    assert off.max() < 2


@pytest.mark.parametrize("opened", [1.2, 2.2])
def test_nothing_seen_of_a_door_says_how_its_prediction_leans(opened):
    """Nor how open it is believed to be, nor how long."""
    sides = box_sides()
    sides.doors.fill_(True)
    prediction, dense, _ = lying_boxes([0], opened, knob=True)
    bodies = sides.bodies(prediction, dense, (dense, dense + 0.001))
    assert bodies.known.all() and bodies.points.shape == (2, 1, LOOKS * DOOR_SIZE.read, 3)
    door = prediction.part_pose[0, 1, :3, :3] @ screw_motion(HINGE, PIVOT, torch.tensor(ZERO), REVOLUTE)[:3, :3].mT
    assert (door.mT @ bodies.frames[0, 0]).diagonal().amin() > 0.999  # as the door lies, and not the box
    assert (bodies.normal[0] @ prediction.base_pose[0, :3, 2]) > 0.999  # what turns is the box
    away = (bodies.points[0, 0] - prediction.joint_pivot[0, 0]) @ door
    assert away[:, 2].abs().max() < 0.1 and away[:, 1].max() < 1e-3  # the door alone

    for lean in torch.tensor([[0.0, 0.05, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.05]]):
        turn = se3(roma.rotvec_to_rotmat(lean), torch.zeros(3))
        leaning = replace(prediction, base_pose=prediction.base_pose @ turn, part_pose=prediction.part_pose @ turn)
        short = replace(leaning, part_shape=0.7 * leaning.part_shape)
        for other in (leaning, short):
            seen = sides.bodies(other, dense, (dense,))
            torch.testing.assert_close(seen.frames, bodies.frames, atol=1e-2, rtol=0)
            same = (seen.points[0, 0, :, None] == bodies.points[0, 0]).all(-1).any(-1)
            assert same.double().mean() > 0.95


@pytest.mark.parametrize(("count", "known"), [(300, True), (200, False)])
def test_a_door_of_few_points_is_looked_at_again_and_of_fewer_not_at_all(count, known):
    sides = box_sides()
    sides.doors.fill_(True)
    prediction, dense, _ = lying_boxes([0], 2.2)
    own = sides._doors(prediction, dense, sides._boxes(prediction.base_pose, dense)[:, :, 0])[1]
    behind = ((dense - prediction.base_pose[:, None, :3, 3]) @ prediction.base_pose[:, :3, 2:3]).squeeze(-1) > 0
    some = torch.cat([dense[own][:count], dense[~own & behind]])[None]
    bodies = sides.bodies(prediction, some, (some,))
    assert bodies.known.item() == known
    if known:
        seen, surface = bodies.points[0, 0], bodies.surface[0, 0]
        assert len(seen.unique(dim=0)) < 330
        again = (seen == seen[0]).all(dim=-1).nonzero()[1, 0]
        assert torch.equal(seen[again : 2 * again], seen[:again])
        assert torch.equal(surface[again : 2 * again], surface[:again])


def test_of_doors_it_does_not_show_at_which_side_a_hinge_is():
    """What looks right is the same of a door and of its mirror image, whatever the network."""
    torch.manual_seed(0)
    sides = box_sides()
    sides.doors.fill_(True)
    sides.surface = SurfaceDecision(TINY).requires_grad_(False)
    prediction, dense, _ = lying_boxes([0, 2], knob=True)
    bodies = sides.bodies(prediction, dense, (dense,))
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    across = bodies.frames[:, 0] @ mirror @ bodies.frames[:, 0].mT  # camera space
    points, surface = bodies.points @ across.mT, bodies.surface.clone()
    surface[..., -3:] = (surface[..., -3:].float() @ across.mT).half()
    looks = sides.looks_right(bodies)
    assert looks.shape == (2, 2) and (looks[:, 0] - looks[:, 1]).abs().max() > 1e-3
    torch.testing.assert_close(
        sides.looks_right(bodies._replace(points=points, surface=surface)), looks, atol=1e-3, rtol=0
    )
    # Seen as it is only, it shows.
    sides.doors.fill_(False)
    alone = sides.looks_right(bodies._replace(points=points, surface=surface)) - sides.looks_right(bodies)
    assert alone.abs().max() > 1e-2


def test_nothing_seen_of_a_body_says_where_its_door_is():
    """However wide it is open, and although the prediction is tilted: frames are square to the box, points its own."""
    sides = box_sides()
    seen = []
    for opened in (0.3, 1.2, 2.2):
        torch.manual_seed(0)
        prediction, dense, true = lying_boxes([0], opened)
        tilt = se3(roma.rotvec_to_rotmat(torch.tensor([[0.12, 0.05, -0.06]])), torch.zeros(1, 3))
        prediction = turned_about(prediction, prediction.base_pose[:, :3, 2], torch.zeros(1))
        tilted = Prediction(**{**prediction.__dict__, "base_pose": prediction.base_pose @ tilt})
        bodies = sides.bodies(tilted, dense, (dense, dense + 0.001))
        assert bodies.known.all() and bodies.points.shape == (2, 1, LOOKS * BODY_SIZE.read, 3)
        own = (bodies.points[0, 0] - prediction.base_pose[0, :3, 3]) @ prediction.base_pose[0, :3, :3]
        assert own[:, 2].min() > -0.26 + 0.05  # behind the door's plane, and none of an open door before it
        assert own[:, :2].abs().amax() < 0.39
        square = (true[0].T @ bodies.frames[0]).abs()
        assert (square.amax(dim=-1) > 0.999).all()
        quarter = bodies.frames[0, :-1].mT @ bodies.frames[0, 1:]
        expected = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, QUARTER])).expand(TURNS - 1, 3, 3)
        torch.testing.assert_close(quarter, expected, atol=1e-5, rtol=0)
        # Nor by which of its points are taken for the door's.
        mixed = Prediction(**{**tilted.__dict__, "part_shape": tilted.part_shape.flip(1)})
        assert torch.equal(sides.bodies(mixed, dense, (dense,)).points[0], bodies.points[0])
        seen.append(bodies.frames)
    torch.testing.assert_close(bodies.points[1], bodies.points[0] + 0.001, atol=1e-6, rtol=0)


def test_where_too_little_is_behind_the_door_nothing_is_decided():
    prediction, dense, _ = lying_boxes([1, 1])
    sides = box_sides()
    sides.surface = TopIsUp()
    for count in (700, 300):
        kept, _ = sides.decided(prediction, dense[:, :count])
        torch.testing.assert_close(kept.base_pose, prediction.base_pose)
        assert torch.equal(kept.margin, prediction.margin)


@pytest.fixture
def box_module(monkeypatch):
    """A module that ever learns the same of its lessons: `TopIsUp`."""
    module = tiny_module(num_parts=2).eval()
    module.states.seen.copy_(torch.tensor([[-0.3, 0.9]]))  # to one side of the canonical shape's state
    monkeypatch.setattr(hinge_lessons, "FEWEST", 20)
    monkeypatch.setattr(hinge_lessons, "teach", lambda *_: TopIsUp())
    monkeypatch.setattr(hinge_lessons, "_predictions", lambda *_: [])
    return module


def _drawn(quarters: torch.Tensor, up: int = 1) -> Bodies:
    body = box_parts(torch.Generator().manual_seed(0), 3000, up)[0]
    body = body[torch.randperm(len(body), generator=torch.Generator().manual_seed(1))[: LOOKS * SIZE.read]]
    axes = box_sides().axes
    turn = roma.rotvec_to_rotmat(quarters[:, None] * QUARTER * axes[:, 2])
    points = (body @ turn.mT)[None]
    steps = roma.rotvec_to_rotmat(torch.arange(TURNS)[:, None] * torch.tensor([0.0, 0.0, QUARTER]))
    surface = torch.zeros(*points.shape[:-1], 37, dtype=torch.float16)
    count = len(quarters)
    frames = (axes @ steps).expand(count, -1, -1, -1)
    return Bodies(points, surface, frames, frames[:, 0, :, 2], torch.ones(count) > 0)


@pytest.mark.parametrize(("share", "learnt"), [(0.12, True), (0.0, False), (0.6, False)], ids=["some", "none", "most"])
def test_some_that_lie_are_learnt(box_module, monkeypatch, share, learnt):
    quarters = torch.where(torch.rand(200, generator=torch.Generator().manual_seed(2)) < share, 3, 0)
    monkeypatch.setattr(hinge_lessons, "_bodies", lambda _, clouds, *__, **___: _drawn(quarters[: len(clouds)]))
    learn_hinge_sides(box_module, torch.zeros(200, POINTS, 3))
    sides = box_module.hinge_sides
    assert bool(sides.learnt) == learnt
    if learnt:
        assert float(sides.log_prior[3].exp()) == pytest.approx(share, abs=0.08)
        assert sides.log_prior.argmax() == 0
    else:
        assert sides.surface is None


def _seen_by_an_upright_camera(lying: torch.Tensor) -> torch.Tensor:
    """Base poses [n, 4, 4] of objects that turn about their vertical, some of which are explained lying."""
    turn = torch.rand(len(lying), 1, generator=torch.Generator().manual_seed(1)) - 0.5
    azimuth = roma.rotvec_to_rotmat(2 * turn * torch.tensor([0.0, 1.0, 0.0]))
    lies = roma.rotvec_to_rotmat(lying[:, None] * QUARTER * torch.tensor([0.0, 0.0, 1.0]))
    return se3(azimuth @ lies, torch.zeros(len(lying), 3))


@pytest.mark.parametrize(("share", "learnt"), [(0.12, True), (0.0, False), (0.6, False)], ids=["some", "none", "most"])
def test_an_upright_camera_needs_no_network(monkeypatch, share, learnt):
    lying = (torch.rand(200, generator=torch.Generator().manual_seed(2)) < share).float()
    poses, known = _seen_by_an_upright_camera(lying), box_sides()
    module = tiny_module(num_parts=2, orientation_range=100.0).eval()
    monkeypatch.setattr(hinge_lessons, "FEWEST", 20)
    monkeypatch.setattr(hinge_lessons, "_predictions", lambda *_: [SimpleNamespace(base_pose=poses)])
    monkeypatch.setattr(hinge_lessons, "teach", None)
    monkeypatch.setattr(HingeSides, "measure", lambda self, *_: self.axes.copy_(known.axes))
    learn_hinge_sides(module, torch.zeros(200, POINTS, 3))
    sides = module.hinge_sides
    assert bool(sides.learnt) == bool(sides.camera.learnt) == learnt
    if learnt:
        prediction, _, _ = lying_boxes([0, 0])
        rows = torch.tensor([int(lying.argmin()), int(lying.argmax())])
        stood, quarters = sides.decided(replace(prediction, base_pose=poses[rows]), None)
        assert quarters.tolist() == [0, 3]
        torch.testing.assert_close(stood.base_pose[:, :3, 1], torch.tensor([[0.0, 1.0, 0.0]] * 2), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("share", "right", "orientation", "learnt"),
    [
        (0.12, True, 100.0, True),
        (0.6, True, 100.0, True),
        (0.0, True, 100.0, False),
        (0.6, True, 180.0, False),
        (0.6, False, 100.0, False),
    ],
    ids=["some", "most", "none", "any way", "a camera mistakes them"],
)
def test_of_simulated_views_it_is_known_which_lie(monkeypatch, share, right, orientation, learnt):
    lying = (torch.rand(200, generator=torch.Generator().manual_seed(2)) < share).float()
    # Turned so that they stand: three quarters on.
    quarters = (3 if right else 1) * lying.long()
    poses, known = _seen_by_an_upright_camera(lying), box_sides()
    monkeypatch.setattr(hinge_lessons, "FEWEST", 20)
    monkeypatch.setattr(hinge_lessons, "_predictions", None)  # nothing is asked
    monkeypatch.setattr(HingeSides, "measure", lambda self, *_: self.axes.copy_(known.axes))
    module = tiny_module(num_parts=2, orientation_range=orientation).eval()
    points, part = torch.rand(200, POINTS, 3), torch.zeros(200, POINTS)
    module.view_search.learn(points, poses, torch.zeros(200, 1), part, quarters)
    learn_hinge_sides(module, torch.zeros(200, POINTS, 3))
    assert bool(module.hinge_sides.learnt) == bool(module.hinge_sides.camera.learnt) == learnt


def test_a_few_points_of_the_body_do_not_make_the_door_another():
    shape = box_shape()
    label = shape.label.clone()
    label[:480:60] = 1
    sides = HingeSides()
    sides.measure(replace(shape, label=label), torch.tensor([[ZERO + 0.9, ZERO + 1.8]]))
    assert float(sides.closed) == pytest.approx(ZERO, abs=0.02)


def test_nothing_is_learnt_where_too_little_is_seen(box_module, monkeypatch):
    unknown = _drawn(torch.zeros(64))._replace(known=torch.arange(64) < 50)
    monkeypatch.setattr(hinge_lessons, "_bodies", lambda *_, **__: unknown)
    monkeypatch.setattr(hinge_lessons, "teach", None)
    learn_hinge_sides(box_module, torch.zeros(100, POINTS, 3))
    assert not box_module.hinge_sides.learnt


def test_lessons_turn_what_the_network_disagrees_with(box_module, monkeypatch):
    quarters = torch.where(torch.rand(200, generator=torch.Generator().manual_seed(2)) < 0.12, 1, 0)
    monkeypatch.setattr(hinge_lessons, "_bodies", lambda _, clouds, *__, **___: _drawn(quarters[: len(clouds)]))
    given = []
    monkeypatch.setattr(hinge_lessons, "teach", lambda lessons, *_: given.append(lessons) or TopIsUp())
    learn_hinge_sides(box_module, torch.zeros(200, POINTS, 3))
    first, *later = (lessons.frames[:, 0] for lessons in given)
    assert len(later) == 2 and (first == first[0]).all()  # as all are predicted
    for frames in later:
        away = roma.rotmat_geodesic_distance(frames, first) > 1
        assert 0.04 < away.double().mean() < 0.2
        torch.testing.assert_close(given[0].frames.sum(dim=1), given[1].frames.sum(dim=1))


@pytest.mark.parametrize("hidden", [False, True], ids=["bodies tell", "bodies do not"])
def test_doors_are_shown_where_all_bodies_seem_to_stand_alike(box_module, monkeypatch, hidden):
    quarters = torch.where(torch.rand(200, generator=torch.Generator().manual_seed(2)) < 0.12, 2, 0)
    sides, given, up = box_module.hinge_sides, [], 0 if hidden else 1

    def seen(_, clouds, *__, **___):
        return _drawn(quarters[: len(clouds)] * (0 if hidden and not sides.doors else 1), up)

    monkeypatch.setattr(hinge_lessons, "_bodies", seen)
    monkeypatch.setattr(hinge_lessons, "teach", lambda lessons, *_: given.append(lessons) or TopIsUp(up))
    learn_hinge_sides(box_module, torch.zeros(200, POINTS, 3))
    assert sides.learnt and bool(sides.doors) == hidden
    assert [lessons.mirrored for lessons in given] == [False] * 3 + [True] * hidden
    assert [lessons.frames.shape[1] for lessons in given] == [4] * 3 + [2] * hidden
    assert [lessons.doubt > 0 for lessons in given] == [lessons.mirrored for lessons in given]
    measured = HingeSides()
    shape = box_module.articulated.category.articulated_shape(REVOLUTE)
    measured.measure(shape, box_module.states.known, box_module.estimator.part_frames)
    torch.testing.assert_close(sides.closed, torch.tensor(0.3) if hidden else measured.closed)
    # Where states count from the middle of the range, so does that of the closed door.
    torch.testing.assert_close(sides.shut, measured.shut - (sides.closed if hidden else 0))
    assert float(sides.log_prior.exp()[1 if hidden else 2]) == pytest.approx(0.12, abs=0.08)


class Undecided(TopIsUp):
    """Everything looks as right to it."""

    def seen(self, cloud):
        return 0 * super().seen(cloud)


@pytest.mark.parametrize("mirrored", [False, True], ids=["bodies tell in the mirror", "bodies do not"])
def test_where_half_are_upside_down_doors_say_which(box_module, monkeypatch, mirrored):
    """Lessons that believe predictions teach nothing; those that begin with what doors say turn half of them."""
    turned = torch.arange(200) % 2
    sides, given = box_module.hinge_sides, []

    def seen(_, clouds, *__, behind=False):
        return _drawn(turned[: len(clouds)] * (2 if sides.doors and not behind else 0), 0)

    def teach(lessons, *_):
        given.append(lessons)
        told = not lessons.mirrored or len(lessons.frames[:, 0].unique(dim=0)) > 1
        return TopIsUp(0) if told or (len(given) == 5 and not mirrored) else Undecided(0)

    monkeypatch.setattr(hinge_lessons, "_bodies", seen)
    monkeypatch.setattr(hinge_lessons, "teach", teach)
    monkeypatch.setattr(hinge_lessons, "upside_down", lambda doors: turned[: len(doors.known)])
    learn_hinge_sides(box_module, torch.zeros(200, POINTS, 3))
    assert bool(sides.learnt) == bool(sides.doors) == mirrored
    # Bodies three times, doors, bodies in the mirror; then doors three times, half of them turned.
    assert [lessons.mirrored for lessons in given] == [False] * 3 + [True] * (5 if mirrored else 2)
    if mirrored:
        assert float(sides.closed) == pytest.approx(0.3)
        assert sides.log_prior[:2].exp().tolist() == pytest.approx([0.5, 0.5], abs=0.1)
    else:
        assert sides.surface is None


def test_it_is_part_of_the_weights_and_older_ones_have_none():
    module = tiny_module(num_parts=2)
    module.hinge_sides.surface = SurfaceDecision().requires_grad_(False)
    module.hinge_sides.learnt.fill_(True)
    module.hinge_sides.doors.fill_(True)
    module.hinge_sides.closed.fill_(0.7)
    other = tiny_module(num_parts=2)
    other.load_state_dict(module.state_dict())
    assert other.hinge_sides.learnt and other.hinge_sides.doors and other.hinge_sides.surface is not None
    torch.testing.assert_close(other.state_range, other.states.limits - 0.7)
    older = {name: value for name, value in module.state_dict().items() if "hinge_sides" not in name}
    other.load_state_dict(older)
    assert other.hinge_sides.surface is None


def test_what_whole_clouds_taught_is_left_out(caplog):
    """As until 2026-11-26."""
    module, other = tiny_module(num_parts=2), tiny_module(num_parts=2)
    module.hinge_sides.surface = SurfaceDecision().requires_grad_(False)
    module.hinge_sides.learnt.fill_(True)
    older = {name: value for name, value in module.state_dict().items() if "hinge_sides.doors" not in name}
    other.load_state_dict(older | {"hinge_sides.whole": torch.tensor(True)})
    assert not other.hinge_sides.learnt and other.hinge_sides.surface is None
    assert "teach it again" in caplog.text
    other.load_state_dict(older | {"hinge_sides.whole": torch.tensor(False)})
    assert other.hinge_sides.learnt and other.hinge_sides.surface is not None


def test_predictions_count_from_the_closed_door_with_and_without_a_dense_cloud():
    module = tiny_module(num_parts=2).eval()
    clouds = torch.rand(2, POINTS, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    dense = torch.rand(2, 2000, 3, generator=torch.Generator().manual_seed(4)) - 0.5
    before = module.predict_points(clouds, dense=dense)
    sides = module.hinge_sides
    sides.learnt.fill_(True)
    sides.closed.fill_(0.4)
    sides.door.copy_(torch.tensor([0.0, 0.0, -9.0]))  # all is behind it
    sides.surface = TopIsUp()
    alone, after = module.predict_points(clouds), module.predict_points(clouds, dense=dense)
    for prediction in (alone, after):
        torch.testing.assert_close(prediction.joint_state, before.joint_state - 0.4, atol=1e-5, rtol=0)
        torch.testing.assert_close(_posed(prediction), _posed(before), atol=1e-4, rtol=0)
        _holds(prediction)
    torch.testing.assert_close(alone.base_pose, before.base_pose)
