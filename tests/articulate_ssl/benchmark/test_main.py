"""The benchmark's output: bench.json, with every number that is promised, and the plots."""

import json

import pytest

from articulate_ssl.benchmark import __main__ as benchmark
from articulate_ssl.benchmark.result import Result


def test_every_number_of_the_contract_is_written(monkeypatch, tmp_path):
    sizes = [1, 2, 4]
    growth = {name: (sizes, [1.0, 2.0, 4.0], [10.0, 20.0, 40.0]) for name in ("points", "group", "parts", "batch")}
    ratios = ("conv_fwd", "conv_fwd_bwd", "backbone_fwd_bwd", "backbone_memory", "chamfer_fwd_bwd")
    sections = {
        "operators": [f"{name}_ratio" for name in ratios],
        "data_pipeline": ["loader_samples_per_s", "partial_frames_per_s", "complete_clouds_per_s"],
        "whole_network": [f"train_step_s_{name}" for name in ("cpu_profile", "paper")]
        + [f"inference_clouds_per_s_b{batch}" for batch in (1, 64)],
    }
    for section, keys in sections.items():
        monkeypatch.setattr(
            benchmark, section, lambda _, keys=keys: [Result(key, key, [1.0, 3.0, 2.0]) for key in keys]
        )
    monkeypatch.setattr(benchmark, "growth", lambda machine: growth)
    benchmark.main(["--device", "cpu", "--output", str(tmp_path / "build"), "--plot", str(tmp_path / "plot.png")])
    numbers = json.loads((tmp_path / "build" / "bench.json").read_text())
    exponents = {f"exponent_{name}" for name in growth}
    assert set(numbers) == {key for keys in sections.values() for key in keys} | exponents | {"device"}
    assert numbers["conv_fwd_ratio"] == 2
    assert all(numbers[name] == pytest.approx(1) for name in exponents)
    assert (tmp_path / "plot.png").stat().st_size > 10_000
    assert (tmp_path / "build" / "bench.png").exists()
