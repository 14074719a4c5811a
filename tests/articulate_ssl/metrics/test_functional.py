import itertools
import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from articulate_ssl.metrics.functional import (
    PARALLEL_BELOW,
    SKEW_ABOVE,
    axis_angle_error,
    best_assignment,
    chamfer_l1,
    iou_matrix,
    legacy_axis_error,
    legacy_chamfer,
    legacy_fold,
    legacy_pivot_error,
    legacy_rematch,
    line_to_line_distance,
    nearest_index,
    part_iou,
    rotation_error,
    state_error,
)

DOUBLE = torch.float64


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(*shape, generator=generator, dtype=DOUBLE), dim=-1)


def rotation_error_naive(first, second):
    """Arc cosine of the trace: exact away from 0 and pi."""
    trace = (first.transpose(-1, -2) @ second).diagonal(dim1=-2, dim2=-1).sum(-1)
    return ((trace - 1) / 2).clamp(-1, 1).acos()


def line_to_line_distance_naive(axis1, pivot1, axis2, pivot2):
    """Smallest distance over the two line parameters, by least squares."""
    result = []
    for a1, p1, a2, p2 in zip(axis1, pivot1, axis2, pivot2, strict=True):
        matrix, right = torch.stack([a1, -a2], dim=1), (p2 - p1)[:, None]
        result.append((matrix @ torch.linalg.lstsq(matrix, right).solution - right).norm())
    return torch.stack(result)


def test_rotation_error_equals_naive_between_the_ends():
    first, second = roma.unitquat_to_rotmat(unit(200, 4)), roma.unitquat_to_rotmat(unit(200, 4, seed=1))
    torch.testing.assert_close(rotation_error(first, second), rotation_error_naive(first, second), atol=1e-7, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi / 2, 2.5, math.pi - 1e-4, math.pi - 1e-9, math.pi])
def test_rotation_error_is_unfolded_and_sharp_at_both_ends(angle):
    base = roma.unitquat_to_rotmat(unit(50, 4))
    turned = base @ roma.rotvec_to_rotmat(unit(50, 3, seed=1) * angle)
    torch.testing.assert_close(rotation_error(turned, base), torch.full((50,), angle, dtype=DOUBLE), atol=1e-12, rtol=0)


def test_folding_hides_chance():
    errors = rotation_error(roma.unitquat_to_rotmat(unit(4000, 4)), torch.eye(3, dtype=DOUBLE))
    assert abs(errors.rad2deg().mean() - 126.5) < 2
    assert abs(legacy_fold(errors).rad2deg().mean() - 45) < 2


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 30.0, 90.0, 91.0, 179.999999, 180.0])
def test_axis_error_is_undirected(degrees):
    angle = math.radians(degrees)
    first = torch.tensor([1.0, 0, 0], dtype=DOUBLE)
    second = torch.tensor([math.cos(angle), math.sin(angle), 0], dtype=DOUBLE)
    assert axis_angle_error(first, second).item() == pytest.approx(min(angle, math.pi - angle), abs=1e-14)


def test_line_distance_equals_least_squares_for_skew_lines():
    axis1, axis2 = unit(100, 3), unit(100, 3, seed=1)
    pivot1, pivot2 = 2 * unit(100, 3, seed=2), unit(100, 3, seed=3)
    clear = axis_angle_error(axis1, axis2) > SKEW_ABOVE
    assert clear.sum() > 90
    expected = line_to_line_distance_naive(axis1[clear], pivot1[clear], axis2[clear], pivot2[clear])
    found = line_to_line_distance(axis1[clear], pivot1[clear], axis2[clear], pivot2[clear])
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-9)


def line(axis, pivot):
    return torch.tensor(axis, dtype=DOUBLE), torch.tensor(pivot, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("predicted", "target", "expected"),
    [
        (([1.0, 0, 0], [0.0, 0, 0]), ([1.0, 0, 0], [5.0, 0.3, 0.4]), 0.5),  # parallel
        (([1.0, 0, 0], [0.0, 0, 0]), ([-1.0, 0, 0], [5.0, 0.3, 0.4]), 0.5),  # antiparallel
        (([1.0, 0, 0], [0.0, 0, 0]), ([1.0, 0, 0], [7.0, 0, 0]), 0.0),  # the same line
        (([1.0, 0, 0], [0.0, 0, 0]), ([0.0, 1, 0], [3.0, 9, 0]), 0.0),  # intersecting
        (([1.0, 0, 0], [0.0, 0, 0]), ([0.0, 1, 0], [3.0, 9, 0.25]), 0.25),  # skew
    ],
)
def test_line_distance_of_known_lines(predicted, target, expected):
    assert line_to_line_distance(*line(*predicted), *line(*target)).item() == pytest.approx(expected, abs=1e-12)


def test_nearly_parallel_lines_are_not_excused_by_meeting_far_away():
    angle = PARALLEL_BELOW / 2
    axis = torch.tensor([math.cos(angle), math.sin(angle), 0], dtype=DOUBLE)
    # These lines meet, but 11 diagonals away from the object; around it they are 0.1 apart.
    distance = line_to_line_distance(axis, torch.zeros(3, dtype=DOUBLE), *line([1.0, 0, 0], [0.0, 0.1, 0]))
    assert distance.item() == pytest.approx(0.1, rel=1e-3)


def test_line_distance_is_continuous_in_the_angle():
    angle = torch.linspace(0, 2 * SKEW_ABOVE, 4001, dtype=DOUBLE)
    axis = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    target_axis, target_pivot = line([1.0, 0, 0], [0.4, 0.1, 0.05])
    distance = line_to_line_distance(
        axis, torch.zeros_like(axis), target_axis.expand_as(axis), target_pivot.expand_as(axis)
    )
    # Worst step seen: 5.1e-5.
    assert distance.diff().abs().max() < 1e-4
    assert distance[0].item() == pytest.approx(math.hypot(0.1, 0.05))
    assert distance[-1].item() == pytest.approx(0.05)


@settings(max_examples=200, deadline=None)
@given(st.floats(0, 1e-3), st.floats(-10, 10), st.floats(-10, 10))
def test_line_distance_is_finite_and_never_above_the_distance_of_the_pivots(tilt, along, beside):
    axis = torch.nn.functional.normalize(torch.tensor([1.0, tilt, 0], dtype=DOUBLE), dim=0)
    pivot = torch.tensor([along, beside, 0.1], dtype=DOUBLE)
    distance = line_to_line_distance(axis, pivot, *line([1.0, 0, 0], [0.0, 0, 0]))
    assert 0 <= distance <= pivot.norm() + 1e-12


def test_state_error_wraps_turns_but_not_lengths():
    predicted, target = torch.tensor([3.1, 3.1]), torch.tensor([-3.1, -3.1])
    error = state_error(predicted, target, torch.tensor([True, False]))
    torch.testing.assert_close(error, torch.tensor([2 * math.pi - 6.2, 6.2]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("count", "other"), [(1, 1), (1, 7), (20, 13)])
def test_nearest_and_chamfer_equal_loops(count, other):
    first, second = unit(2, count, 3).float(), unit(2, other, 3, seed=1).float()
    table = (first[:, :, None].double() - second[:, None].double()).norm(dim=-1)
    distance, index = nearest_index(first, second)
    torch.testing.assert_close(distance, table.amin(2))
    assert torch.equal(index, table.argmin(2))
    expected = (table.amin(2).mean(1) + table.amin(1).mean(1)) / 2
    torch.testing.assert_close(chamfer_l1(first, second), expected)
    expected = (table.amin(2).square().mean(1).sqrt() + table.amin(1).square().mean(1).sqrt()) / 2
    torch.testing.assert_close(legacy_chamfer(first, second), expected)


def test_chamfer_of_identical_clouds_is_zero():
    points = unit(3, 500, 3).float()
    assert chamfer_l1(points, points.flip(1)).abs().max() == 0


def test_iou_equals_sets():
    generator = torch.Generator().manual_seed(0)
    predicted = torch.randint(3, (4, 50), generator=generator)
    target = torch.randint(2, (4, 50), generator=generator)  # part 2 is not there
    matrix = iou_matrix(predicted, target, 3)
    for b, i, j in itertools.product(range(4), range(3), range(3)):
        p, t = predicted[b] == i, target[b] == j
        assert matrix[b, i, j] == (p & t).sum().double() / (p | t).sum()
    assert torch.equal(part_iou(predicted, target, 3)[:, 2], torch.zeros(4, dtype=DOUBLE))


def test_iou_of_a_part_that_nobody_has_is_undefined():
    labels = torch.zeros(1, 5, dtype=torch.long)
    assert part_iou(labels, labels, 2)[0].tolist() == pytest.approx([1.0, math.nan], nan_ok=True)


def test_best_assignment_equals_brute_force():
    for seed in range(10):
        score = torch.rand(4, 4, generator=torch.Generator().manual_seed(seed))
        best = max(itertools.permutations(range(4)), key=lambda rows: sum(score[r, c] for c, r in enumerate(rows)))
        assert best_assignment(score).tolist() == list(best)


def test_rematching_chooses_per_cloud():
    iou = torch.tensor([[[0.9, 0.1], [0.1, 0.9]], [[0.1, 0.9], [0.9, 0.1]]])
    assert legacy_rematch(iou).tolist() == [[0, 1], [1, 0]]


def test_legacy_fold():
    degrees = torch.tensor([0.0, 30, 90, 150, 180])
    torch.testing.assert_close(legacy_fold(degrees.deg2rad()).rad2deg(), torch.tensor([0.0, 30, 90, 30, 0]))


def test_legacy_axis_error_is_the_angle_of_the_mean_cosine():
    axis = torch.tensor([[[1.0, 0, 0], [1.0, 0, 0]]])
    target = torch.tensor([[[1.0, 0, 0], [0.0, 1, 0]]])
    assert legacy_axis_error(axis, target).rad2deg().item() == pytest.approx(60)


def test_legacy_pivot_error_compares_scalars_not_lines():
    centroid = torch.tensor([[1.0, 1, 1]])
    axis, pivot = torch.tensor([[[1.0, 0, 0]]]), centroid[:, None] + torch.tensor([[[0.0, 0.3, 0]]])
    opposite = centroid[:, None] - torch.tensor([[[0.0, 0.3, 0]]])
    assert legacy_pivot_error(opposite, axis, pivot, centroid).item() == pytest.approx(0, abs=1e-6)
    assert line_to_line_distance(axis, opposite, axis, pivot).item() == pytest.approx(0.6)
