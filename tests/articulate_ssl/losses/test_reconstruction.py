"""Reconstruction distances against their definitions, written as loops."""

import pytest
import torch

from articulate_ssl.losses.reconstruction import (
    balanced_association,
    distances_to_cloud,
    distances_to_parts,
    owned_parts,
    part_by_part,
    part_of_mass,
    posterior_association,
    whole_shape,
)


def _naive_to_parts(points, posed):
    """|x_n - nearest point of part k|, by the whole distance matrix."""
    return torch.stack([torch.cdist(points, part).amin(dim=-1) for part in posed.unbind(1)], dim=-1)


def _naive_to_cloud(posed, points, labels=None):
    rows = []
    for b, parts in enumerate(posed):
        row = []
        for k, part in enumerate(parts):
            own = points[b] if labels is None else points[b][labels[b] == k]
            row.append(torch.cdist(part, own if len(own) else points[b]).amin(dim=-1))
        rows.append(torch.stack(row))
    return torch.stack(rows)


def _clouds(dtype=torch.float64, batch=2, parts=3, shape=9, points=40):
    generator = torch.Generator().manual_seed(0)
    cloud = torch.rand(batch, points, 3, dtype=dtype, generator=generator) - 0.5
    posed = torch.rand(batch, parts, shape, 3, dtype=dtype, generator=generator) - 0.5
    labels = torch.randint(parts, (batch, points), generator=generator)
    return cloud, posed.requires_grad_(), labels


def _assert_same(value, expected, leaf, rtol=1e-6):
    torch.testing.assert_close(value, expected, rtol=rtol, atol=1e-6)
    weight = torch.rand(value.shape, dtype=value.dtype, generator=torch.Generator().manual_seed(1))
    ours, theirs = (torch.autograd.grad((v * weight).sum(), leaf)[0] for v in (value, expected))
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_distances_to_parts_are_nearest_distances():
    points, posed, _ = _clouds()
    _assert_same(distances_to_parts(points, posed), _naive_to_parts(points, posed), posed)


def test_of_several_nearest_points_one_that_strayed_decides_nothing():
    generator = torch.Generator().manual_seed(0)
    near, far = 0.1 * torch.rand(1, 20, 3, generator=generator), 1 + 0.1 * torch.rand(1, 20, 3, generator=generator)
    points = near[:, :1] + 0.01
    far[:, 0] = points[:, 0]  # a point of the far part where the near one is
    posed = torch.stack([near, far], dim=1)
    assert distances_to_parts(points, posed).argmin(dim=-1) == 1
    several = distances_to_parts(points, posed, 3)
    assert several.argmin(dim=-1) == 0
    expected = (points[:, None] - posed).norm(dim=-1).sort(dim=-1).values[..., :3].mean(dim=-1)
    torch.testing.assert_close(several[:, 0], expected, atol=1e-3, rtol=0)
    assert torch.equal(distances_to_parts(points, posed, 50), distances_to_parts(points, posed, 20))


@pytest.mark.parametrize("labelled", [False, True])
def test_distances_to_the_cloud_are_nearest_distances(labelled):
    points, posed, labels = _clouds()
    labels = labels if labelled else None
    _assert_same(distances_to_cloud(posed, points, labels), _naive_to_cloud(posed, points, labels), posed)


def test_labels_keep_their_precision_in_float32():
    points, posed, labels = _clouds(torch.float32, points=300)
    expected = _naive_to_cloud(posed.double(), points.double(), labels).float()
    torch.testing.assert_close(distances_to_cloud(posed, points, labels), expected, rtol=1e-3, atol=3e-4)


def test_a_part_without_points_is_compared_with_the_whole_cloud():
    points, posed, labels = _clouds()
    labels[labels == 1] = 0
    distance = distances_to_cloud(posed, points, labels)
    torch.testing.assert_close(distance[:, 1], _naive_to_cloud(posed, points)[:, 1], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(distance, _naive_to_cloud(posed, points, labels), rtol=1e-6, atol=1e-6)


def test_a_part_of_one_point_is_compared_with_it_alone():
    points, posed, labels = _clouds()
    labels[labels == 2] = 0
    labels[:, 7] = 2
    expected = (posed[:, 2] - points[:, 7, None]).norm(dim=-1)
    torch.testing.assert_close(distances_to_cloud(posed, points, labels)[:, 2], expected, rtol=1e-6, atol=1e-6)


def test_coincident_points_have_finite_gradients():
    points, posed, labels = _clouds()
    with torch.no_grad():
        posed[:, 0] = points[:, :9]
        posed[:, 1] = points[:, :1]
    points.requires_grad_()
    total = distances_to_parts(points, posed).sum() + distances_to_cloud(posed, points, labels).sum()
    for gradient in torch.autograd.grad(total, (points, posed)):
        assert gradient.isfinite().all()


def test_the_posterior_gives_points_to_the_nearest_part_and_carries_no_gradient():
    points, posed, _ = _clouds()
    to_part = distances_to_parts(points, posed)
    association = posterior_association(to_part, 0.03)
    assert not association.requires_grad
    torch.testing.assert_close(association.sum(dim=-1), torch.ones(2, 40, dtype=torch.float64))
    assert torch.equal(association.argmax(dim=-1), to_part.argmin(dim=-1))
    sharp = posterior_association(to_part, 1e-3).amax(dim=-1)
    assert sharp.mean() > association.amax(dim=-1).mean()


def test_losses_are_sums_of_mean_distances():
    points, posed, labels = _clouds()
    to_part, to_cloud = distances_to_parts(points, posed), distances_to_cloud(posed, points)
    union = torch.cdist(points, posed.flatten(1, 2))
    chamfer = union.amin(dim=2).mean(dim=1) + union.amin(dim=1).mean(dim=1)
    torch.testing.assert_close(whole_shape(to_part, to_cloud), chamfer, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(whole_shape(to_part, None), union.amin(dim=2).mean(dim=1), rtol=1e-5, atol=1e-6)
    certain = torch.nn.functional.one_hot(labels, 3).double()
    own = torch.stack([to_part[b, torch.arange(40), labels[b]].mean() for b in range(2)])
    torch.testing.assert_close(part_by_part(to_part, None, certain), own)
    torch.testing.assert_close(part_by_part(to_part, to_cloud, certain), own + to_cloud.mean(dim=(1, 2)))
    exact = part_by_part(to_part, None, posterior_association(to_part, 1e-4))
    torch.testing.assert_close(exact, whole_shape(to_part, None), rtol=1e-4, atol=1e-5)


def test_a_balanced_association_draws_parts_to_equal_shares():
    near, far = torch.full((40, 1), 0.02), torch.full((40, 1), 0.05)
    near[:10] = 0.06  # by distance alone a quarter of the points is the second part's
    to_part = torch.cat([near, far], dim=1)[None]
    shares = [balanced_association(to_part, 0.02, balance).mean(dim=1)[0, 1] for balance in (0.0, 0.5, 1.0)]
    assert shares[0] < 0.3 and shares[0] < shares[1] < shares[2]
    assert shares[2] == pytest.approx(0.5, abs=0.02)
    torch.testing.assert_close(balanced_association(to_part, 0.02, 0.0), posterior_association(to_part, 0.02))
    assert balanced_association(to_part, 0.02, 1.0).sum(dim=-1).sub(1).abs().max() < 1e-5


def test_parts_without_points_do_not_count():
    points, posed, _ = _clouds()
    labels = torch.zeros(2, 40, dtype=torch.long)
    labels[:, 20:] = 1  # the third part owns nothing
    owned = owned_parts(labels, 3)
    assert owned.tolist() == [[True, True, False]] * 2
    association = torch.nn.functional.one_hot(labels, 3).double()
    to_part, to_cloud = distances_to_parts(points, posed), distances_to_cloud(posed, points, labels)
    for loss in (part_of_mass, part_by_part):
        (gradient,) = torch.autograd.grad(loss(to_part, to_cloud, association, owned).sum(), posed, retain_graph=True)
        assert gradient[:, 2].abs().max() == 0 and (gradient[:, :2].abs().amax(dim=(-1, -2)) > 0).all()


def test_a_part_counts_by_its_own_points():
    """A part of few points as much as one of many."""
    to_part = torch.tensor([[[0.1, 9.0]] * 30 + [[9.0, 0.3]] * 2])
    association = torch.tensor([[[1.0, 0.0]] * 30 + [[0.0, 1.0]] * 2])
    owned = torch.ones(1, 2, dtype=torch.bool)
    assert part_of_mass(to_part, None, association, owned).item() == pytest.approx(0.2)
    back = torch.tensor([[[0.5] * 4, [0.1] * 4]])
    assert part_of_mass(to_part, back, association, owned).item() == pytest.approx(0.5)
