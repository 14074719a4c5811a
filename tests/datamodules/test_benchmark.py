"""The loader benchmark runs and counts."""

from __future__ import annotations

import tempfile

from datamodules.benchmark import loader_samples_per_s


def test_it_measures_a_rate_and_cleans_up(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rate = loader_samples_per_s(num_points=16, instances=2, states=8, stored_points=32)
    assert 100 < rate < 1e6
    assert list(tmp_path.iterdir()) == []
