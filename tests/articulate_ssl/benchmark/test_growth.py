"""The fitted exponent of growth."""

import pytest

from articulate_ssl.benchmark.growth import exponent


def test_exponent_of_a_power_law():
    assert exponent([1, 2, 4, 8], [3 * x**1.7 for x in (1, 2, 4, 8)]) == pytest.approx(1.7)
