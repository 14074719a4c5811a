"""Training with the fast backbone and with its twin starts on the same curve, and falls."""

import pytest

from articulate_ssl.benchmark.curves import plot_curves, training_curves
from articulate_ssl.benchmark.machine import Machine


def test_the_first_steps_agree_and_the_plot_is_drawn(tmp_path):
    curves = training_curves(Machine("cpu", "32"), steps=8)
    fast, twin, moved = curves.values()
    assert fast == pytest.approx(twin, rel=1e-4)
    assert fast == pytest.approx(moved, rel=1e-2)
    assert fast != moved
    assert fast[-1] < 0.9 * fast[0]
    plot_curves(curves, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5_000
