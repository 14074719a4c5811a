"""NSD: spherical harmonics are right, a star is where its radii say, hidden surface is left out, and it learns."""

from __future__ import annotations

import math

import numpy as np
import torch
from occupied import write_occupied_set
from scipy.special import sph_harm_y
from torch.testing import assert_close

from articulate_ssl.baselines import method_class
from articulate_ssl.baselines.method import Problem
from articulate_ssl.baselines.nsd import (
    DEGREE,
    DIRECTIONS,
    INITIAL_RADIUS,
    NSD,
    PRIMITIVES,
    sphere_directions,
    spherical_harmonics,
    surface_loss,
)
from articulate_ssl.geometry.screw import REVOLUTE
from datamodules.articulated_data_module import ArticulatedDataModule

PROBLEM = Problem(num_parts=2, joint_type=REVOLUTE, state_range=1.3, num_points=32)


def sphere(radius: float) -> float:
    """The constant coefficient of a sphere."""
    return math.log(math.expm1(radius)) * math.sqrt(4 * math.pi)


def stars(centers: list[list[float]], radii: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Spheres; those that are left over are tiny and far away."""
    center = torch.full((1, PRIMITIVES, 3), 50.0)
    coefficient = torch.zeros(1, PRIMITIVES, (DEGREE + 1) ** 2)
    coefficient[..., 0] = sphere(1e-3)
    for k, (c, r) in enumerate(zip(centers, radii, strict=True)):
        center[0, k], coefficient[0, k, 0] = torch.tensor(c), sphere(r)
    return center, coefficient


def test_spherical_harmonics_are_scipys():
    direction = torch.nn.functional.normalize(sphere_directions(50).double(), dim=-1)
    theta = torch.arccos(direction[:, 2]).numpy()
    phi = torch.atan2(direction[:, 1], direction[:, 0]).numpy()
    expected = []
    for level in range(DEGREE + 1):
        for m in range(-level, level + 1):
            value = (-1) ** m * sph_harm_y(level, abs(m), theta, phi)  # without the Condon-Shortley phase
            part = value.real if m >= 0 else value.imag
            expected.append(part * (1 if m == 0 else math.sqrt(2)))
    np.testing.assert_allclose(spherical_harmonics(direction, DEGREE).numpy(), np.stack(expected, -1), atol=1e-7)


def test_spherical_harmonics_are_orthonormal_and_finite_at_the_poles():
    direction = sphere_directions(20000).double()
    values = spherical_harmonics(direction, 4)
    assert_close(values.T @ values * 4 * math.pi / len(values), torch.eye(25).double(), atol=5e-3, rtol=0)
    pole = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    spherical_harmonics(pole, DEGREE).sum().backward()
    assert pole.grad.isfinite().all()


def test_the_indicator_of_a_sphere():
    method = NSD(PROBLEM)
    points = torch.tensor([[[0.3, 0, 0], [0.4, 0, 0], [0.5, 0, 0], [0.3, 0.4, 0]]])
    indicator = method.indicator(stars([[0.3, 0, 0]], [0.2]), points)[0, :, 0]
    assert_close(indicator, torch.tensor([1.0, 0.5, 0.0, -1.0]), atol=1e-4, rtol=0)


def test_surfaces_are_where_the_indicator_vanishes_and_hidden_in_others():
    torch.manual_seed(0)
    method = NSD(PROBLEM)
    parameters = method.stars(torch.randn(2, 32, 3))
    points, _ = method.surface(parameters)
    own = method.indicator(parameters, points).view(2, PRIMITIVES, DIRECTIONS, PRIMITIVES)
    own = own.diagonal(dim1=1, dim2=3)
    assert_close(own, torch.zeros_like(own), atol=1e-4, rtol=0)
    points, hidden = method.surface(stars([[0, 0, 0], [0, 0, 0], [0.6, 0, 0]], [0.2, 0.5, 0.2]))
    hidden = hidden.view(PRIMITIVES, DIRECTIONS)
    assert hidden[0].all() and not hidden[1, points[0, DIRECTIONS : 2 * DIRECTIONS, 0] < 0].any()
    assert 0 < hidden[2].float().mean() < 1


def test_a_point_belongs_to_the_star_in_which_it_lies_deepest(monkeypatch):
    method = NSD(PROBLEM)
    monkeypatch.setattr(method, "stars", lambda cloud: stars([[0, 0, 0], [1, 0, 0]], [0.5, 0.8]))
    points = torch.tensor([[[0.0, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [1.7, 0, 0], [-3, 0, 0]]])
    assert method.primitive_of(points)[0].tolist() == [0, 0, 1, 1, 1]


def test_the_surface_loss_ignores_what_is_hidden():
    cloud = torch.rand(1, 20, 3)
    far = torch.full((1, 5, 3), 9.0)
    surface = torch.cat([cloud, far], dim=1)
    hidden = torch.arange(25)[None] >= 20
    assert surface_loss(surface, hidden, cloud) < 1e-9
    assert surface_loss(surface, ~hidden, cloud) > 1


def test_primitives_start_as_spheres_that_are_spread_out():
    torch.manual_seed(0)
    method = NSD(PROBLEM)
    center, coefficient = method.stars(torch.zeros(1, 32, 3))
    radius = torch.nn.functional.softplus(coefficient @ method.harmonics.T)
    assert (radius.mean(-1) / INITIAL_RADIUS - 1).abs().max() < 0.5
    assert torch.pdist(center[0]).min() > 0.5 * INITIAL_RADIUS


def test_the_loss_falls(tmp_path):
    folder = write_occupied_set(tmp_path)
    data = ArticulatedDataModule("laptop", str(folder.parents[1]), num_points=32, batch_size=4, occupancy=True)
    data.setup("fit")
    torch.manual_seed(0)
    method = NSD(PROBLEM)
    optimizer = method.configure_optimizers()["optimizer"]
    batch, losses = next(iter(data.train_dataloader())), []
    for step in range(25):
        loss = method.training_step(batch, step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


def test_it_is_a_row_of_the_table():
    assert method_class("nsd") is NSD
