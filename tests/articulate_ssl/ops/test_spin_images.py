import pytest
import roma
import torch

from articulate_ssl.ops import reference
from articulate_ssl.ops.spin_images import HEIGHTS, RINGS, SPIN_CHANNELS, spin_images


def plate(thickness, relief, count=2048, seed=0):
    """Two faces of a plate; the upper one carries steps of a height."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([0.6, 0.5, 1.0]) - torch.tensor([0.3, 0.25, 0.0])
    upper = points[:, 2] > 0.5
    step = relief * ((points[:, 0] * 40).floor() % 2)
    points[:, 2] = torch.where(upper, thickness + step, 0.0)
    return points.double(), upper


def inner(points, count):
    """Whether leading points are far from the plate's edges."""
    return (points[:count, :2].abs() < torch.tensor([0.2, 0.15])).all(1)


def test_rotation_and_translation_change_nothing():
    points, _ = plate(0.02, 0.004)
    rotation = roma.random_rotmat(1, dtype=torch.float64)[0]
    moved = points @ rotation.T + torch.tensor([1.0, -2.0, 0.5])
    (first, normal), (second, turned) = (spin_images(x[None, :200], x[None]) for x in (points, moved))
    torch.testing.assert_close(first, second, atol=1e-6, rtol=0)
    torch.testing.assert_close(normal @ rotation.T, turned, atol=1e-6, rtol=0)
    assert first.shape == (1, 200, SPIN_CHANNELS)


def test_a_plain_face_has_all_of_its_own_at_height_zero_and_the_other_one_below():
    thickness = -HEIGHTS[3]
    points, _ = plate(thickness, 0.0)
    image = spin_images(points[None, :300], points[None])[0][0][inner(points, 300)].unflatten(-1, (len(RINGS) - 1, -1))
    zero = HEIGHTS.index(0.0)
    share = image[..., 3] + image[..., zero]
    assert share.median() > 0.99
    assert image[..., zero + 1 :].sum(-1).median() < 0.01


def test_relief_of_millimetres_shows_on_the_face_that_carries_it():
    points, upper = plate(0.03, 0.004)
    keep = inner(points, 500)
    image = spin_images(points[None, :500], points[None])[0][0][keep].unflatten(-1, (len(RINGS) - 1, -1))
    zero = HEIGHTS.index(0.0)
    beside = image[:, 1, [zero - 1, zero + 1]].sum(-1)
    assert beside[upper[:500][keep]].median() > 3 * beside[~upper[:500][keep]].median() + 0.2


def test_normals_point_out_of_a_plate():
    points, upper = plate(0.02, 0.0)
    _, normal = spin_images(points[None, :400], points[None])
    keep = inner(points, 400)
    sign = torch.where(upper[:400], 1.0, -1.0)[keep]
    assert (normal[0, keep, 2] * sign > 0.99).double().mean() > 0.95


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("leading", [300, 2048])
def test_images_and_normals_are_those_of_the_readable_twin(dtype, leading):
    """Of a plate, another one, and points of which most have too few neighbours."""
    sparse = 3 * torch.rand(2048, 3, generator=torch.Generator().manual_seed(1)).double()
    sparse[:200] *= 0.05
    clouds = torch.stack([plate(0.02, 0.004)[0], plate(0.05, 0.0, seed=2)[0], sparse]).to(dtype)
    found, expected = (images(clouds[:, :leading], clouds) for images in (spin_images, reference.spin_images))
    unknown = expected[1].norm(dim=-1) == 0
    assert unknown.any() and not unknown.all()
    # Where two of a patch's directions are about as thin, rounding turns its plane.
    close = [(one - other).abs().amax(-1) < 1e-3 for one, other in zip(found, expected, strict=True)]
    share = 1 if dtype == torch.float64 else 0.99
    assert all(some.double().mean() >= share for some in close)
    assert torch.equal(found[1].norm(dim=-1) == 0, unknown)
