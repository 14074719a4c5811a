import numpy as np
import pytest
import trimesh

from articulate_ssl.inference.export.part_mesh import part_mesh
from articulate_ssl.ops.farthest_point import farthest_point_order


def surface(mesh: trimesh.Trimesh, count: int, noise: float = 0.0) -> np.ndarray:
    points = np.asarray(trimesh.sample.sample_surface(mesh, 8 * count, seed=1)[0])
    points = points[farthest_point_order(points, count)]
    return points + noise * np.random.default_rng(0).standard_normal(points.shape)


@pytest.mark.parametrize("count", [128, 512])
def test_a_thin_plate_stays_thin(count):
    plate = trimesh.creation.box((0.7, 0.5, 0.02))
    mesh = part_mesh(surface(plate, count))
    assert mesh.is_watertight
    assert mesh.extents[2] == pytest.approx(0.02, rel=1e-3)
    assert 0.75 < mesh.volume / plate.volume <= 1.001


def test_a_noisy_plate_is_closed():
    mesh = part_mesh(surface(trimesh.creation.box((0.7, 0.5, 0.02)), 256, noise=0.01))
    assert mesh.is_watertight and mesh.volume > 0


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_cavity_stays_open(noise):
    outer, inner = trimesh.creation.box((0.6, 0.6, 0.6)), trimesh.creation.box((0.5, 0.6, 0.5))
    case = trimesh.boolean.difference([outer, inner.apply_translation((0, 0.1, 0))])
    mesh = part_mesh(surface(case, 512, noise))
    assert mesh.is_watertight and mesh.body_count == 1
    assert mesh.volume < 0.6 * outer.volume  # the case has 0.42 of it, its hull all


def test_a_ring_keeps_its_hole():
    mesh = part_mesh(surface(trimesh.creation.annulus(0.2, 0.3, 0.05), 512))
    assert mesh.is_watertight
    assert mesh.euler_number == 0


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((256, 3)),
        np.random.default_rng(0).random((256, 3)) * [1, 1, 0],
        np.outer(np.linspace(0, 1, 256), [1, 2, 3]),
    ],
    ids=["one place", "a plane", "a line"],
)
def test_points_without_volume_give_a_closed_mesh(points):
    mesh = part_mesh(points)
    assert mesh.is_watertight and mesh.volume > 0
    assert (mesh.bounds[0] <= points.min(axis=0) + 1e-6).all() and (mesh.bounds[1] >= points.max(axis=0) - 1e-6).all()


def test_repeated_points_change_nothing():
    points = surface(trimesh.creation.annulus(0.2, 0.3, 0.05), 256)
    assert part_mesh(np.repeat(points, 3, axis=0)).volume == pytest.approx(part_mesh(points).volume)
