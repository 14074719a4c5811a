"""Joint regularization: what it is zero for, and what its gradient teaches."""

import torch

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.losses.joint_regularization import joint_line_points, joint_regularization

EDGE = torch.linspace(-0.5, 0.5, 101, dtype=torch.float64)


def _plate(direction) -> torch.Tensor:
    """[M, 3] half plane spanned by the y axis (which it contains) and a direction."""
    side = torch.linspace(0, 0.5, 11, dtype=torch.float64)
    y, s = torch.meshgrid(EDGE, side, indexing="ij")
    y_axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return (y[..., None] * y_axis + s[..., None] * torch.tensor(direction, dtype=torch.float64)).flatten(0, 1)


def _hinge(state: float = 0.7):
    """Two plates that share the y axis, before and after the second turned about it."""
    canonical = torch.stack([_plate([1.0, 0, 0]), _plate([0, 0, 1.0])])[None]
    axis = torch.tensor([[[0.0, 1.0, 0.0]]], dtype=torch.float64)
    pivot = torch.zeros(1, 1, 3, dtype=torch.float64)
    motion = screw_motion(axis[0, 0], pivot[0, 0], torch.tensor(state, dtype=torch.float64), REVOLUTE)
    articulated = canonical.clone()
    articulated[:, 1] = transform_points(motion, canonical[:, 1])
    return canonical, articulated, pivot, axis


NO_CHOICE = torch.zeros(1, 1, dtype=torch.float64)  # two parts have one spanning tree


def test_line_points_lie_evenly_on_both_sides_of_the_pivot():
    pivot, axis = torch.randn(2, 3, 4, 3, dtype=torch.float64)
    axis = torch.nn.functional.normalize(axis, dim=-1)
    line = joint_line_points(pivot, axis, 0.2, count=5)
    assert line.shape == (3, 4, 5, 3)
    along = ((line - pivot[:, :, None]) * axis[:, :, None]).sum(dim=-1)
    expected = torch.tensor([-0.2, -0.1, 0.0, 0.1, 0.2], dtype=torch.float64).expand(3, 4, 5)
    torch.testing.assert_close(along, expected)


def test_it_is_zero_for_a_line_in_both_parts_and_positive_for_any_other():
    canonical, articulated, pivot, axis = _hinge()

    def loss(pivot, axis, joint_type=REVOLUTE):
        return joint_regularization(canonical, articulated, pivot, axis, NO_CHOICE, joint_type, 0.2).item()

    off = pivot + torch.tensor([-0.1, 0, -0.1], dtype=torch.float64)
    tilted = torch.tensor([[[0.6, 0.8, 0.0]]], dtype=torch.float64)
    assert loss(pivot, axis) < 1e-2  # the parts' sampling
    assert loss(pivot + 0.25 * axis, axis) < 1e-2  # any point of the line is as good a pivot
    assert loss(off, axis) > 0.3
    assert loss(pivot, tilted) > 0.1
    assert loss(pivot, tilted, PRISMATIC) < 1e-2  # an axis of sliding need not lie in the parts
    assert loss(off, axis, PRISMATIC) > 0.3


def test_a_line_that_leaves_a_part_when_it_moves_is_penalised():
    """In the moving part at rest but off its axis of rotation: zero before articulation, positive after it."""
    canonical, articulated, pivot, axis = _hinge()
    both = canonical[:, 1:].expand(-1, 2, -1, -1)
    inside = pivot + torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    still = joint_regularization(both, both, inside, axis, NO_CHOICE, REVOLUTE, 0.2)
    moved = torch.stack([canonical[:, 1], articulated[:, 1]], dim=1)
    assert still < 1e-2 < 0.1 < joint_regularization(both, moved, inside, axis, NO_CHOICE, REVOLUTE, 0.2)


def test_its_gradient_trains_the_confidences_towards_the_parts_that_touch():
    """Parts 0-1 and 1-2 touch in a line, 0-2 do not: descent must end in that tree from an uninformed start."""
    first, second = _plate([1.0, 0, 0]), _plate([0, 0, 1.0])
    third = second + torch.tensor([0, 0, 0.5], dtype=torch.float64)
    canonical = torch.stack([first, second, third])[None]
    pivot = torch.tensor([[[0, 0, 0], [0.0, 0, 0.25], [0, 0, 0.5]]], dtype=torch.float64)
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(1, 3, 3)
    confidence = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.SGD([confidence], lr=20.0)
    for _ in range(15):
        optimizer.zero_grad()
        loss = joint_regularization(canonical, canonical, pivot, axis, confidence, REVOLUTE, 0.1).sum()
        loss.backward()
        optimizer.step()
    assert confidence[0, [0, 2]].min() > confidence[0, 1] + 2
    assert loss < 0.1


def test_it_has_the_gradient_it_claims():
    generator = torch.Generator().manual_seed(0)
    canonical, articulated = torch.rand(2, 1, 3, 2, 3, dtype=torch.float64, generator=generator)
    pivot, axis = torch.randn(2, 1, 3, 3, dtype=torch.float64, generator=generator)
    confidence = torch.randn(1, 3, dtype=torch.float64, generator=generator)
    inputs = [x.requires_grad_() for x in (canonical, articulated, pivot, axis, confidence)]
    for joint_type in (REVOLUTE, PRISMATIC):
        assert torch.autograd.gradcheck(lambda *x: joint_regularization(*x, joint_type, 0.1), inputs)  # noqa: B023


def test_a_line_through_a_point_of_a_part_has_finite_gradients():
    canonical, articulated, pivot, axis = _hinge()
    inputs = [x.requires_grad_() for x in (canonical, articulated, pivot, axis)]
    loss = joint_regularization(*inputs, NO_CHOICE, REVOLUTE, 0.0).sum()
    for gradient in torch.autograd.grad(loss, inputs):
        assert gradient.isfinite().all()
