"""Faces say how boxes and plates are turned, and about which direction their joints turn; round things do not."""

import math
from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import LAPTOP, OVEN, Clouds, clouds, true_hypotheses, true_shape
from tiny import POINTS, tiny_module

from articulate_ssl.geometry.screw import screw_motion
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference import part_frames
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.part_frames import WINDOWS, Faces, PartFrames, faces_of, square_to
from articulate_ssl.inference.proportions import Descent, fit_proportions
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.training import frame_lessons
from articulate_ssl.training.frame_lessons import learn_part_frames, rough_axes

DENSE = 2400
TILT = roma.rotvec_to_rotmat(math.radians(5) * torch.tensor([0.6, 0.0, 0.8]))  # of the joint that is believed
TURNED, MOVED = 4.0, 8.0  # degrees by which explanations are off, at most


def _data(design=OVEN, count: int = 24, seed: int = 0) -> Clouds:
    return clouds(design, count=count, points=DENSE, resample=True, proportions=0.2, seed=seed)


def _explained(design, data: Clouds, seed: int = 1) -> Hypotheses:
    """The truth, a few degrees off: bases, states, and the joint's direction."""
    generator = torch.Generator().manual_seed(seed)
    count, one = len(data.base), true_hypotheses(design, data)
    off = roma.rotvec_to_rotmat(math.radians(TURNED) * (2 * torch.rand(count, 3, generator=generator) - 1) / 3**0.5)
    base = se3(data.base[:, :3, :3] @ off, data.base[:, :3, 3])
    state = data.state + math.radians(MOVED) * (2 * torch.rand(data.state.shape, generator=generator) - 1)
    axis = one.axis @ TILT.mT
    one = replace(one, structure=replace(one.structure, axis=axis, pair_axis=axis))
    return one.at(base[:, None], state[:, None])


def _learnt(design, data: Clouds) -> tuple[PartFrames, torch.Tensor]:
    """Frames learnt from clouds, and the quality of every part."""
    one = _explained(design, data)
    frames, shape = PartFrames(one.chain.num_parts), true_shape(design, data)
    believed = replace(shape, joints=replace(shape.joints, axis=shape.joints.axis @ TILT.mT))
    return frames, frames.learn(one, _windows(one, data), rough_axes(believed))


def _windows(one: Hypotheses, data: Clouds) -> tuple[Faces, Faces]:
    return tuple(faces_of(one, data.points, [window] * one.chain.num_parts) for window in WINDOWS)


def _degrees(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return roma.rotmat_geodesic_distance(one, other).rad2deg()


def _angle(one: torch.Tensor, other: torch.Tensor) -> float:
    """Degrees between unit directions."""
    return float((one @ other).clamp(max=1).acos().rad2deg())


@pytest.fixture(scope="module")
def oven():
    """Frames learnt from ovens whose joint is believed to be tilted by five degrees."""
    return _learnt(OVEN, _data())


def test_faces_measure_the_direction_of_the_joint(oven):
    frames, quality = oven
    assert frames.flat.tolist() == [True, True]
    assert frames.measured.tolist() == [True]
    assert (quality[:, 0] > 0.9).all()
    assert _angle(frames.direction[0], torch.tensor([0.0, 1.0, 0.0])) < 1


def test_a_direction_that_is_parallel_to_nothing_is_measured_as_it_is():
    """A door that turns about a line across the faces of its body: no axis of the box takes its place."""
    slant = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 0.25]), dim=0)
    boxes, parents, _, ranges, kind = OVEN
    design = (boxes, parents, [(tuple(slant.tolist()), (0.5, 0, 0.05))], ranges, kind)
    frames, _ = _learnt(design, _data(design, count=48))
    assert _angle(frames.direction[0], slant) < 2  # believed: 5, parallel: 14


def test_explanations_are_turned_to_faces(oven):
    frames, data = oven[0], _data(seed=7)
    before = _explained(OVEN, data, seed=8)
    after, (turned, moved) = frames.settled(before, data.points)
    assert turned.all()
    assert moved.all()
    off = [_degrees(one.base[:, 0, :3, :3], data.base[:, :3, :3]) for one in (before, after)]
    assert off[0].median() > 1.5
    assert off[1].median() < 0.5
    assert off[1].max() < 1.5
    states = [(one.state[:, 0] - data.state).rad2deg().abs() for one in (before, after)]
    assert states[0].median() > 3
    assert states[1].median() < 1
    middle = before.object_shape()[:, 0].mean(dim=1, keepdim=True)
    places = [transform_points(one.base[:, 0], middle) for one in (before, after)]
    torch.testing.assert_close(*places, atol=1e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_clouds_that_are_turned_are_settled_alike(oven, dtype):
    frames, data = PartFrames(2), _data(count=4, seed=9)
    frames.load_state_dict(oven[0].state_dict())
    frames.to(dtype)
    one = _cast(_explained(OVEN, data), dtype)
    torch.manual_seed(0)
    turn = roma.random_rotmat(4).to(dtype)
    pose = se3(turn, torch.randn(4, 3, dtype=dtype))
    seen = data.points.to(dtype)
    still, _ = frames.settled(one, seen)
    moved, _ = frames.settled(one.at(pose[:, None] @ one.base, one.state), transform_points(pose, seen))
    tolerance = 1e-2 if dtype == torch.float32 else 1e-6  # learnt in float32
    torch.testing.assert_close(moved.base[:, 0], pose @ still.base[:, 0], atol=tolerance, rtol=0)
    torch.testing.assert_close(moved.state, still.state, atol=tolerance, rtol=0)


def _cast(one: Hypotheses, dtype: torch.dtype) -> Hypotheses:
    lines = {name: getattr(one.structure, name).to(dtype) for name in ("pivot", "axis")}
    shape = CanonicalShape(*(value.to(dtype) for value in one.shape))
    return replace(
        one,
        shape=shape,
        structure=replace(one.structure, **lines),
        base=one.base.to(dtype),
        state=one.state.to(dtype),
    )


def test_what_is_too_far_from_its_faces_stays(oven, monkeypatch):
    """Base and states, where faces would turn them by more than they may."""
    frames, data = oven[0], _data(count=6, seed=3)
    one = _explained(OVEN, data)
    monkeypatch.setattr(part_frames, "FARTHEST", 1e-3)
    after, (turned, moved) = frames.settled(one, data.points)
    assert not turned.any()
    assert not moved.any()
    torch.testing.assert_close(after.base, one.base)
    torch.testing.assert_close(after.state, one.state)


@pytest.mark.parametrize("off", [-40, -25, 5, 40])
def test_doors_that_are_farther_off_than_normals_reach_are_found(off):
    """As those beside a panel: registration turns them until their ends are where they should be."""
    torch.manual_seed(0)
    turn = roma.random_rotmat(6)
    axis, frame = turn[:, :, 1], turn @ _about_y(torch.full((6,), float(-off)))
    noise = 0.02 * torch.randn(6, 200, 3, generator=torch.Generator().manual_seed(0))
    normal = torch.nn.functional.normalize(turn[:, None, :, 2] + noise, dim=-1)
    faces = Faces(normal, torch.ones(6, 200))
    angle = part_frames._squared_from_afar(axis, frame, faces)
    torch.testing.assert_close(angle.rad2deg(), torch.full((6,), float(off)), atol=0.5, rtol=0)
    near = part_frames._squared_about(axis, frame, faces)
    assert ((near - angle).rad2deg().abs() < 0.5).all() == (abs(off) < 20)


def test_faces_that_are_square_however_a_part_turns_do_not_keep_it_where_it_is():
    """The sides of a door are, and may be most of what is seen of it."""
    normal = torch.tensor([[0.0, 1.0, 0.0]] * 150 + [[0.0, 0.0, 1.0]] * 50)[None]
    faces, axis = Faces(normal, torch.ones(1, 200)), torch.tensor([[0.0, 1.0, 0.0]])
    angle = part_frames._squared_from_afar(axis, _about_y(torch.tensor([-35.0])), faces)
    torch.testing.assert_close(angle.rad2deg(), torch.tensor([35.0]), atol=0.1, rtol=0)


def test_normals_that_point_anywhere_turn_nothing_far():
    """As those of a handle: within reach they pull as ever."""
    generator, frames = torch.Generator().manual_seed(0), torch.eye(3).expand(64, 3, 3)
    normal = torch.nn.functional.normalize(torch.randn(64, 200, 3, generator=generator), dim=-1)
    faces, axis = Faces(normal, torch.ones(64, 200)), torch.tensor([0.0, 1.0, 0.0]).expand(64, 3)
    angle = part_frames._squared_from_afar(axis, frames, faces)
    torch.testing.assert_close(angle, part_frames._squared_about(axis, frames, faces))


def _about_y(degrees: torch.Tensor) -> torch.Tensor:
    return roma.rotvec_to_rotmat(torch.tensor([0.0, 1.0, 0.0]) * degrees.deg2rad()[:, None])


@pytest.mark.parametrize("afar", [False, True])
def test_joints_turn_far_if_that_is_asked_for(oven, monkeypatch, afar):
    frames, data = oven[0], _data(count=6, seed=3)
    one = true_hypotheses(OVEN, data)
    asked = "_squared_from_afar" if afar else "_squared_about"
    monkeypatch.setattr(part_frames, asked, lambda axis, *_: torch.full_like(axis[:, 0], math.radians(30)))
    after, (_, moved) = frames.settled(one, data.points, afar)
    assert (moved == afar).all()
    torch.testing.assert_close(after.state, one.state + math.radians(30) * afar)


def test_plates_turn_about_what_all_of_them_are_square_to():
    """A laptop's base has nearly all of its faces on two sides: in its own plane its frame is not known."""
    frames, _ = _learnt(LAPTOP, _data(LAPTOP))
    assert frames.flat.tolist() == [True, True]
    assert frames.measured.tolist() == [True]
    assert _angle(frames.direction[0], torch.tensor([0.0, 1.0, 0.0])) < 1  # believed: 5


@pytest.mark.parametrize(
    ("most", "tilt", "measured"),
    [(60, 0, True), (5, 0, False), (60, 10, False)],
    ids=["turned", "nearly parallel", "the hinge is not in the plate"],
)
def test_plates_say_about_what_they_turn_if_that_is_clear(most, tilt, measured):
    angle = torch.linspace(-most, most, 13)
    still, turn = (
        torch.eye(3).repeat(13, 1, 1),
        _about_y(angle) @ roma.rotvec_to_rotmat(math.radians(tilt) * torch.tensor([1.0, 0.0, 0.0])),
    )
    # Of a plate: all normals are along the third axis of its frame.
    body, part = (Faces(frame[:, :, 2][:, None].expand(-1, 40, -1), torch.ones(13, 40)) for frame in (still, turn))
    frames, believed = PartFrames(2), torch.nn.functional.normalize(torch.tensor([0.05, 1.0, 0.05]), dim=0)
    frames._measure_plates(0, (0, body, still), (part, turn), believed)
    assert frames.measured.tolist() == [measured]
    if measured:
        assert _angle(frames.direction[0], torch.tensor([0.0, 1.0, 0.0])) < 0.1


def test_a_door_that_bulges_is_a_plate_as_a_whole():
    """Its normals point everywhere; in the wide window all of them are one."""
    data = _data()
    door = data.part == 1
    away = (data.rest[door][:, 1:] - torch.tensor([0.3, 0.225])).norm(dim=-1)
    bulge = torch.zeros_like(data.rest)
    bulge[door, 0] = 0.12 * (1 - away / 0.3).clamp(min=0).sqrt() - 0.04 * (away * 40).sin()
    turn = torch.stack([screw_motion(data.axis[0], data.pivot[0], state, 0) for state in data.state[:, 0]])
    pose = (data.base @ turn)[:, :3, :3]
    moved = data._replace(points=data.points + bulge @ pose.mT, rest=data.rest + bulge)
    frames, _ = _learnt(OVEN, moved)
    assert frames.flat.tolist() == [True, True]
    assert frames.wide.tolist() == [False, True]
    after, _ = frames.settled(_explained(OVEN, moved, seed=8), moved.points)
    assert (after.state[:, 0] - data.state).rad2deg().abs().median() < 3


def test_balls_have_no_faces():
    """Where the root is round nothing is learnt, though the door has faces."""
    data = _data()
    root = data.part == 0
    inside = data.rest[root]
    middle, radius = torch.tensor([0.25, 0.3, 0.25]), 0.25
    ball = middle + radius * torch.nn.functional.normalize(inside - middle, dim=-1)
    points = data.points.clone()
    points[:, root] = transform_points(data.base, ball.expand(len(points), -1, -1))
    rest = data.rest.clone()
    rest[root] = ball
    frames, quality = _learnt(OVEN, data._replace(points=points, rest=rest))
    assert quality[0, 1] > 5
    assert not frames.learnt


def test_frames_that_lie_otherwise_in_every_cloud_are_none(monkeypatch):
    """The share decides: with faces that are turned at random, nothing is learnt."""

    def at_random(frame, faces):
        return frame @ roma.random_rotmat(len(frame)), torch.ones(len(frame))

    monkeypatch.setattr(part_frames, "square_to", at_random)
    frames, quality = _learnt(OVEN, _data())
    assert quality[0, 0] < 0.5
    assert not frames.learnt


def test_few_points_turn_nothing(oven):
    frames, data = oven[0], _data(count=3)
    one = _explained(OVEN, data)
    after, (turned, moved) = frames.settled(one, data.points[:, :30])
    assert not turned.any()
    assert not moved.any()
    torch.testing.assert_close(after.base, one.base)
    torch.testing.assert_close(after.state, one.state)


def test_a_frame_is_squared_where_normals_leave_nothing_open(oven):
    data = _data(count=5, seed=4)
    one = _explained(OVEN, data)
    faces = _windows(one, data)[0].of(0)
    frame, angle = square_to(one.base[:, 0, :3, :3] @ oven[0].axes[0], faces)
    inward = data.base[:, :3, :3].mT @ frame
    assert (_degrees(inward, inward.round()) < 1).all()
    assert (angle < 5).all()


def test_proportions_keep_what_faces_said(oven):
    """And parts stretch along their faces: an oven that is as wide as high has any principal axes."""
    frames, data = oven[0], _data(count=6, seed=5)
    one, known = frames.settled(_explained(OVEN, data), data.points)
    shape = true_shape(OVEN, data)
    order = shape.label.argsort(stable=True)
    shape = replace(shape, points=shape.points[order], label=shape.label[order])
    fitted = fit_proportions(one, shape, data.points[:, :600], Descent(10, faces=frames.axes, known=known))
    torch.testing.assert_close(fitted.base[..., :3, :3], one.base[..., :3, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(fitted.state, one.state)
    free = fit_proportions(one, shape, data.points[:, :600], Descent(10, faces=frames.axes))
    assert not torch.allclose(free.state, one.state)
    back = transform_points(invert_se3(fitted.base[:, 0]), data.points)
    width = [points.amax(dim=1) - points.amin(dim=1) for points in (back, fitted.object_shape()[:, 0])]
    assert ((width[1] / width[0])[:, 1] - 1).abs().median() < 0.05


def test_weights_from_before_know_no_faces():
    frames = PartFrames(2)
    state = {name: value for name, value in tiny_module().state_dict().items() if "part_frames" not in name}
    module = tiny_module()
    module.load_state_dict(state)
    assert not module.part_frames.learnt
    assert set(frames.state_dict()) == {"flat", "wide", "axes", "measured", "direction"}


@pytest.mark.parametrize(("worse", "learnt"), [(1.0, True), (1.1, True), (1.3, False)])
def test_a_module_learns_from_what_it_predicts(monkeypatch, worse, learnt):
    """Its explanations, of all clouds it is given, and the category's shape for a start.

    And nothing, if shapes fit worse by what it has learnt.
    """
    module, data = tiny_module(), _data(count=20)
    one, asked = _explained(OVEN, data), []

    def explained(points, num_points, dense):
        assert (points.shape[1], num_points) == (frame_lessons.registered_points(module), module.num_points)
        asked.append(len(points))
        return one.rows(torch.arange(sum(asked) - len(points), sum(asked)))

    shape = true_shape(OVEN, data)
    monkeypatch.setattr(module.estimator, "explained", explained)
    monkeypatch.setattr(module.articulated.category, "articulated_shape", lambda kind: shape)
    monkeypatch.setattr(
        module.estimator.final,
        "distance",
        lambda _, points: torch.full((len(points),), worse if module.part_frames.learnt else 1.0),
    )
    monkeypatch.setattr(frame_lessons, "learn_joint_axes", lambda *_: False)
    learn_part_frames(module, data.points)
    assert asked == [16, 4]
    assert module.part_frames.flat.tolist() == [learnt, learnt]
    assert learnt or not module.part_frames.measured.any()


@pytest.mark.parametrize(
    ("orientation_range", "unidirectional", "lines", "common"),
    [(180.0, False, True, True), (100.0, False, True, False), (100.0, True, False, False)],
)
def test_lines_are_learnt_unless_scans_have_taught_them(monkeypatch, orientation_range, unidirectional, lines, common):
    module, data = tiny_module(orientation_range=orientation_range), _data(count=4)
    module.estimator.observation = replace(module.estimator.observation, unidirectional=unidirectional)
    one, asked = _explained(OVEN, data), []
    monkeypatch.setattr(module.estimator, "explained", lambda points, *_: one)
    monkeypatch.setattr(module.articulated.category, "articulated_shape", lambda kind: true_shape(OVEN, data))
    monkeypatch.setattr(frame_lessons, "_explain_as_well", lambda *_: True)
    monkeypatch.setattr(frame_lessons, "learn_joint_axes", lambda *_: False)
    monkeypatch.setattr(frame_lessons, "learn_joint_lines", lambda _, one, clouds: asked.append("lines") or one)
    monkeypatch.setattr(frame_lessons, "_learn_common_shape", lambda *_: asked.append("common"))
    learn_part_frames(module, data.points)
    assert asked == ["lines"] * lines + ["common"] * common


def test_an_estimate_with_dense_clouds_is_settled(oven, monkeypatch):
    """And one without, as with networks alone, is not."""
    module = tiny_module(inference=InferenceOptions(proportions=2))
    module.eval()
    module.part_frames.load_state_dict(oven[0].state_dict())
    seen = []

    def settled(one, dense, afar=False):
        seen.append(dense.shape[1])
        return one, (torch.ones(len(dense), dtype=torch.bool), torch.zeros(len(dense), 1, dtype=torch.bool))

    monkeypatch.setattr(module.part_frames, "settled", settled)
    monkeypatch.setattr(module.estimator.square_search, "sought", lambda *of: of[:3])  # which settles others, too
    points = torch.randn(2, 4 * POINTS, 3) / 4
    module.predict_points(points[:, :POINTS], dense=points)
    module.predict_points(points[:, :POINTS])
    module.predict_points(points[:, :POINTS], refine=False, dense=points)
    assert seen == [4 * POINTS] * 2  # before proportions are fitted, and once more


@pytest.mark.parametrize("flat", [torch.tensor([1.0, 1.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)])
def test_what_has_collapsed_has_axes(flat):
    """A sheet, a rod, a point: training must not end in an error of the hull."""
    data = _data(LAPTOP, count=1)
    shape = true_shape(LAPTOP, data)
    axes = rough_axes(replace(shape, points=shape.points * flat))
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3).expand(2, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(2))
