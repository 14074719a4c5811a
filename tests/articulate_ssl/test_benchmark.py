"""The benchmark's own arithmetic, its twin of the backbone, and its output."""

import json

import pytest
import torch
from rich.console import Console

from articulate_ssl import benchmark
from articulate_ssl.benchmark import Machine, OriginalBackbone, Result, exponent
from articulate_ssl.network.backbone import EquivariantBackbone

MACHINE = Machine("cpu", "32")


def _small_backbone():
    torch.manual_seed(0)
    return EquivariantBackbone(12, (4, 6), (0.2, 0.3), num_neighbors=10)


def test_the_original_backbone_computes_the_same():
    backbone = _small_backbone().double()
    points = 0.5 * torch.rand(2, 40, 3, dtype=torch.float64)
    torch.testing.assert_close(OriginalBackbone(backbone)(points), backbone(points), rtol=1e-9, atol=1e-9)


def test_training_with_either_backbone_follows_the_same_loss():
    curves = []
    for wrap in (lambda backbone: backbone, OriginalBackbone):
        backbone = _small_backbone()
        network = wrap(backbone)
        optimizer = torch.optim.Adam(backbone.parameters(), 1e-2)
        generator = torch.Generator().manual_seed(1)
        curve = []
        for _ in range(20):
            points = 0.5 * torch.rand(2, 30, 3, generator=generator)
            radius = points.sub(points.mean(dim=1, keepdim=True)).norm(dim=-1)
            loss = (network(points).mean(dim=(2, 3)) - radius).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            curve.append(loss.item())
        curves.append(curve)
    assert curves[0][-1] < 0.5 * curves[0][0]
    assert curves[0] == pytest.approx(curves[1], rel=1e-3)


def test_exponent_of_a_power_law():
    assert exponent([1, 2, 4, 8], [3 * x**1.7 for x in (1, 2, 4, 8)]) == pytest.approx(1.7)


def test_peak_memory_sees_a_temporary():
    size = 2**26
    peak = MACHINE.peak_bytes(lambda: torch.ones(size // 4).sum())
    assert peak == pytest.approx(size, rel=0.2)


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


def test_a_generator_that_fails_is_reported_and_left_out(monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "loader_samples_per_s", lambda: 5.0)
    monkeypatch.setattr(benchmark.sys, "executable", "/bin/false")
    (result,) = benchmark.data_pipeline(Console())
    assert result.key == "loader_samples_per_s"
    assert "generation not measured" in capsys.readouterr().out


def test_training_step_changes_the_network():
    options = benchmark.NetworkOptions(
        group_order=12,
        dims=[4, 6],
        radii=[0.2, 0.3],
        num_neighbors=8,
        num_kernel_points=13,
        head_dim=8,
        shape_points=16,
    )
    step = benchmark._training_step(MACHINE, options, batch=2, num_points=32)
    step()
    assert MACHINE.seconds(step) > 0
