import numpy as np
import pytest
from scipy.spatial import cKDTree

from articulate_ssl.ops import reference
from articulate_ssl.ops.least_variance import least_variance

COUNTS = (3, 9, 25)


def neighbours(points: np.ndarray) -> np.ndarray:
    return cKDTree(points).query(points, k=max(COUNTS))[1]


@pytest.mark.parametrize("thickness", [0.2, 5e-3, 1e-5])
@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_it_is_that_of_the_twin(thickness, shift):
    generator = np.random.default_rng(0)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    points = generator.normal(size=(500, 3)) * [0.3, 0.2, thickness] @ turn + shift
    near = neighbours(points)
    found, expected = (how(points, near, COUNTS) for how in (least_variance, reference.least_variance))
    assert found.shape == (500, len(COUNTS))
    # As lengths: where two directions vary alike, half of the digits of a closed form are lost.
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(expected.clip(min=0)), atol=1e-6)
    assert np.sqrt(expected[:, 2].min()) > 5e-6


@pytest.mark.parametrize("spans", [0, 1, 2, 3])
def test_what_spans_too_few_directions_varies_by_nothing(spans):
    points = np.zeros((40, 3))
    points[:, :spans] = np.random.default_rng(1).normal(size=(40, spans))
    found = least_variance(points, neighbours(points), COUNTS)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert (found[:, 1:] > 1e-6).all() if spans == 3 else (found < 1e-14).all()


def test_alike_in_all_directions():
    """A ball's matrix is a multiple of the identity, where the closed form divides by nothing."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    every = np.tile(np.arange(6), (6, 1))
    np.testing.assert_allclose(least_variance(points, every, (6,)), 1 / 3)
