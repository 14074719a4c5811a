"""OP-Align's geometry against known articulated clouds, its training, and its prediction's frames."""

from dataclasses import fields, replace

import pytest
import roma
import torch
from geometry.rigid_motions import random_pose
from tiny import NETWORK, quiet_trainer, tiny_data
from torch.nn.functional import normalize, one_hot

from articulate_ssl.baselines.method import Problem
from articulate_ssl.baselines.op_align import OPAlign
from articulate_ssl.baselines.op_align.alignment import (
    JointGuess,
    joint_state,
    part_alignments,
    part_copies,
    side_alignments,
)
from articulate_ssl.baselines.op_align.objective import (
    Weights,
    coincide,
    density_aware,
    far_pivots,
    local_density,
    object_reconstruction,
    part_reconstruction,
    probability_floor,
)
from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, rotation_between, se3, transform_points
from articulate_ssl.inference.prediction import Prediction

POINTS = 48
TINY = replace(NETWORK, group_order=60, directions=True)
PROBLEMS = [(2, REVOLUTE), (4, REVOLUTE), (2, PRISMATIC), (4, PRISMATIC)]
problems = pytest.mark.parametrize(("num_parts", "joint_type"), PROBLEMS)


class TinyOPAlign(OPAlign):
    network = TINY


def tiny_method(num_parts=2, joint_type=REVOLUTE, orientation_range=180.0, seed=0):
    torch.manual_seed(seed)
    return TinyOPAlign(Problem(num_parts, joint_type, 1.2, POINTS, orientation_range))


def articulated_star(num_parts, joint_type):
    """Y, its labels, X' (articulated, then moved rigidly), what a perfect PointNet says of both, states and motions."""
    generator = torch.Generator().manual_seed(num_parts)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    joints = num_parts - 1
    axis, pivot = normalize(draw(joints, 3), dim=-1), 0.3 * draw(joints, 3)
    state = torch.linspace(-0.5, 0.7, joints + 2, dtype=torch.float64)[1:-1] + 0.2
    shape, label = 0.3 * draw(1, 60, 3), torch.arange(60) % num_parts
    rigid = random_pose(seed=3)
    if joint_type == PRISMATIC:  # sliding cannot undo a turn: the object level must have done that
        rigid = se3(torch.eye(3, dtype=torch.float64), rigid[:3, 3])
    motion = screw_motion(axis, pivot, state, joint_type)
    pose = rigid @ forward_kinematics(motion, [0] * joints, list(range(1, num_parts)), num_parts)
    seen_points = transform_points(pose[label], shape[0][:, None])[:, 0][None]

    zero = torch.zeros(1, joints, 2, dtype=torch.float64)
    canonical = JointGuess(one_hot(label, num_parts)[None].double(), pivot[None], axis[None], zero)
    seen_axis, seen_pivot = axis @ rigid[:3, :3].T, transform_points(rigid, pivot)
    # What the smallest turn between the axes leaves over is a turn about the axis: the shared side's state undoes it.
    left = rigid[:3, :3].T @ rotation_between(seen_axis, axis).mT
    shared = (roma.rotmat_to_rotvec(left) * axis).sum(-1) if joint_type == REVOLUTE else torch.zeros(joints)
    sides = -torch.stack([shared, shared - state], dim=-1)[None].double()
    seen = JointGuess(canonical.probability, seen_pivot[None], seen_axis[None], sides)
    return shape, seen_points, seen, canonical, state, pose


@problems
def test_true_parts_joints_and_states_leave_no_part_level_loss(num_parts, joint_type):
    shape, points, seen, canonical, state, pose = articulated_star(num_parts, joint_type)

    def loss(guess):
        copies, shared = part_copies(points, side_alignments(guess, canonical, joint_type))
        return part_reconstruction(copies, shape, guess.probability, canonical.probability) + coincide(shared)

    assert loss(seen) < 1e-12
    assert loss(replace(seen, state=seen.state + torch.tensor([0.0, 0.2]))) > 1e-3
    assert loss(replace(seen, probability=seen.probability.roll(1, dims=-1))) > 1e-2
    torch.testing.assert_close(joint_state(seen, canonical), state[None])
    sides = side_alignments(seen, canonical, joint_type)
    torch.testing.assert_close(invert_se3(part_alignments(sides))[0], pose, atol=1e-9, rtol=0)


def test_part_losses_teach_parts_and_states():
    shape, points, seen, canonical, _, _ = articulated_star(2, REVOLUTE)
    logits = torch.zeros_like(seen.probability, requires_grad=True)
    sides = side_alignments(seen, canonical, REVOLUTE)
    copies, _ = part_copies(points, sides)
    part_reconstruction(copies, shape, logits.softmax(-1), canonical.probability).backward()
    right = -logits.grad.gather(2, seen.probability.argmax(-1, keepdim=True))
    assert (right > -1e-12).all() and (right > 1e-5).double().mean() > 0.8

    state = (seen.state + torch.tensor([0.0, 0.1])).requires_grad_()
    copies, _ = part_copies(points, side_alignments(replace(seen, state=state), canonical, REVOLUTE))
    part_reconstruction(copies, shape, seen.probability, canonical.probability).backward()
    assert state.grad[0, 0, 1] > 1e-3


@problems
def test_a_pivot_off_the_object_stays_where_parts_fit(num_parts, joint_type):
    shape, points, seen, canonical, _, _ = articulated_star(num_parts, joint_type)
    nearest = torch.cdist(seen.pivot, points).argmin(dim=-1)[0]
    towards = normalize(points[:, nearest] - seen.pivot, dim=-1)
    distance = torch.linspace(0, 0.2, 41, dtype=torch.float64)
    weights = Weights()

    def loss(moved):
        guess = replace(seen, pivot=seen.pivot + moved * towards)
        copies, _ = part_copies(points, side_alignments(guess, canonical, joint_type))
        fit = part_reconstruction(copies, shape, guess.probability, canonical.probability)
        return weights.reconstruction * fit + weights.pivot * far_pivots(guess.pivot, points)

    assert far_pivots(seen.pivot, points) > 0.1  # of pivots that are off the object
    assert distance[torch.stack([loss(moved) for moved in distance]).argmin()] < 0.01


def test_the_base_shape_learns_faster_than_the_networks():
    method = tiny_method()
    base = method.object_level.base_shape
    groups = method.configure_optimizers()["optimizer"].param_groups
    rates = {parameter: group["initial_lr"] for group in groups for parameter in group["params"]}
    assert rates.keys() == set(method.parameters())
    assert {rate for parameter, rate in rates.items() if parameter is not base} == {method.effort.learning_rate}
    assert rates[base] == pytest.approx(10 * method.effort.learning_rate)


def test_density_aware_distance_equals_its_readable_twin():
    generator = torch.Generator().manual_seed(0)
    clouds = [0.2 * torch.randn(2, n, 3, dtype=torch.float64, generator=generator) for n in (30, 40)]
    results = []
    for function in (
        density_aware,
        lambda x, y, alpha: 1 - torch.exp(-alpha * torch.cdist(x, y).square().min(dim=-1).values),
    ):
        leaves = [c.clone().requires_grad_() for c in clouds]
        value = function(*leaves, 30.0)
        results.append((value, *torch.autograd.grad(value.sum(), leaves)))
    for ours, readable in zip(*results, strict=True):
        torch.testing.assert_close(ours, readable)
    far = clouds[0] + 100
    torch.testing.assert_close(density_aware(far, clouds[1], 30.0), torch.ones(2, 30, dtype=torch.float64))


def test_both_directions_of_object_reconstruction_have_one_slope_at_zero():
    generator = torch.Generator().manual_seed(0)
    shape = torch.rand(1, 50, 3, dtype=torch.float64, generator=generator)
    shift = 1e-4
    expected = 2 * 30 * shift**2
    assert object_reconstruction(shape + torch.tensor([shift, 0, 0]), shape) == pytest.approx(expected, rel=1e-4)


def test_regularisers_are_zero_where_nothing_is_wrong():
    grid = torch.cartesian_prod(*[torch.arange(3.0)] * 3)[None]
    ring = torch.linspace(0, 2 * torch.pi, 17)[:-1]
    circle = torch.stack([ring.cos(), ring.sin(), 0 * ring], dim=-1)[None]
    assert local_density(circle, 4) < 1e-10 < 0.01 < local_density(grid, 8)
    assert far_pivots(grid[:, :2] + 50, grid) == pytest.approx(1.0)
    even = torch.full((1, 20, 2), 0.5)
    assert probability_floor(even, even) == 0
    one_sided = torch.tensor([0.99, 0.01]).expand(1, 20, 2)
    assert probability_floor(even, one_sided) == pytest.approx((0.05 - 0.01) / 2)


@problems
def test_training_lowers_the_loss(num_parts, joint_type):
    method = tiny_method(num_parts, joint_type)
    points = 0.2 * torch.randn(4, POINTS, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1, 2, 0.3])
    optimizer = torch.optim.Adam(method.parameters(), lr=3e-3)

    def step():
        loss = sum(getattr(method.weights, name) * value for name, value in method.terms(points, 0.5).items())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.item()

    losses = [step() for _ in range(20)]
    assert losses[-1] < 0.9 * losses[0]


def test_trains_on_a_data_set_and_its_weights_are_all_it_is(tmp_path, synthetic_set):
    method = tiny_method()
    data = tiny_data(tmp_path)
    method.prepare(data, seed=0)
    unit = method.unit.clone()
    quiet_trainer(tmp_path, max_steps=2).fit(method, data)
    assert unit != 2.0 and method.unit == unit
    torch.save(method.state_dict(), tmp_path / "weights.pt")
    again = tiny_method(seed=1)
    again.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True))
    batch = next(iter(data.train_dataloader()))
    first, second = method.eval().predict(batch), again.eval().predict(batch)
    for f in fields(Prediction):
        assert torch.equal(getattr(first, f.name), getattr(second, f.name)), f.name


def varied(method):
    """With heads that say something: fresh ones leave poses at the group's elements."""
    torch.manual_seed(2)
    for head in (method.object_level.pose_head, method.object_level.residual_head):
        torch.nn.init.normal_(head[-1].weight, std=0.3)
    with torch.no_grad():
        method.object_level.base_shape.normal_(std=0.3)
        method.unit.fill_(1.7)
    return method.eval()


def clouds(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.2 * torch.randn(3, POINTS, 3, generator=generator) * torch.tensor([1.0, 2, 0.3])


@problems
def test_predictions_are_complete_and_turn_with_the_cloud(num_parts, joint_type):
    method, points = varied(tiny_method(num_parts, joint_type)), clouds()
    group = method.object_level.backbone.group
    motion = se3(group.elements[17].float(), torch.tensor([0.3, -0.2, 0.5]))
    still = method.predict({"points": points})
    moved = method.predict({"points": transform_points(motion, points)})
    B, K, J = 3, num_parts, num_parts - 1
    assert still.part_pose.shape == (B, K, 4, 4) and still.part_shape.shape == (B, K, POINTS, 3)
    assert still.joint_state.shape == (B, J) and still.canonical_pivot.shape == (B, J, 3)
    assert ((still.margin >= 0) & (still.margin <= 1)).all()
    tolerance = {"atol": 1e-4, "rtol": 0}
    torch.testing.assert_close(moved.part_pose, motion @ still.part_pose, **tolerance)
    torch.testing.assert_close(moved.base_pose, motion @ still.base_pose, **tolerance)
    torch.testing.assert_close(moved.joint_axis, still.joint_axis @ motion[:3, :3].T, **tolerance)
    torch.testing.assert_close(moved.joint_pivot, transform_points(motion, still.joint_pivot), **tolerance)
    for name in ("part_id", "joint_state", "part_shape", "canonical_axis", "canonical_pivot", "reconstruction_error"):
        torch.testing.assert_close(getattr(moved, name), getattr(still, name), **tolerance)


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_predicted_joints_are_what_moves_the_predicted_parts(joint_type):
    method = varied(tiny_method(2, joint_type))
    said = method.predict({"points": clouds()})
    motion = screw_motion(said.canonical_axis, said.canonical_pivot, said.joint_state, joint_type)[:, 0]
    child = said.base_pose @ motion @ se3(torch.eye(3).expand(3, 3, 3), said.assembly[:, 1])
    torch.testing.assert_close(said.part_pose[:, 1], child, atol=1e-5, rtol=0)
    axis = said.canonical_axis @ said.base_pose[:, :3, :3].mT
    torch.testing.assert_close(axis, said.joint_axis, atol=1e-5, rtol=0)
    gap = transform_points(said.base_pose, said.canonical_pivot) - said.joint_pivot
    if joint_type == PRISMATIC:  # the base's own side has slid along the axis, too
        gap = gap - (gap * axis).sum(-1, keepdim=True) * axis
    torch.testing.assert_close(gap, torch.zeros(3, 1, 3), atol=1e-5, rtol=0)


def test_anchors_outside_of_the_orientation_range_never_win():
    method = varied(tiny_method(orientation_range=40.0))
    centred = clouds() - clouds().mean(dim=1, keepdim=True)
    anchors = method.object_level(centred, method.unit)
    allowed = anchors.distance.isfinite()
    assert 1 <= allowed[0].sum() < 60
    turned = roma.rotmat_geodesic_distance(anchors.best()[0], torch.eye(3).expand(3, 3, 3)).rad2deg()
    assert (turned <= 40 + 18 + 1e-3).all()
