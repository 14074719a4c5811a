"""The command for GPUs: what it says without one, and that it runs through, which a CPU can show at a tiny size."""

import json

import pytest
import torch

from articulate_ssl.benchmark import paper_size
from articulate_ssl.benchmark.machine import Machine


@pytest.fixture
def as_it_was(monkeypatch):
    """Lightning leaves a process group behind, and its address in the environment."""
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    precision = torch.get_float32_matmul_precision()
    yield
    torch.set_float32_matmul_precision(precision)
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def test_without_a_gpu_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert paper_size.main([]) == 2
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1
    assert "no GPU here" in said.err and "make bench-gpu" in said.err


def test_no_steps_are_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        paper_size.main(["--device", "cpu", "--steps", "0"])
    assert "--steps 0: at least one step" in capsys.readouterr().err


def test_a_trial_measures_everything(tmp_path, capsys, as_it_was):
    assert paper_size.main(["--device", "cpu", "--steps", "2", "--json", str(tmp_path / "new" / "numbers.json")]) == 0
    numbers = json.loads((tmp_path / "new" / "numbers.json").read_text())
    assert {numbers.pop(name) for name in ("size", "precision", "torch")} == {"trial", "bf16", torch.__version__}
    assert numbers.pop("device") == Machine("cpu", "32").name
    rates = [f"inference_clouds_per_s_b{clouds}" for clouds in (1, 64)]
    trained = ["processes", "train_step_s_paper", "train_minutes_10000_steps", "train_gb"]
    assert set(numbers) == {*trained, *rates, "inference_gb_b1"}
    assert all(value > 0 for value in numbers.values())
    assert numbers["processes"] == 1
    # Of two steps the median is the mean.
    assert numbers["train_minutes_10000_steps"] == pytest.approx(numbers["train_step_s_paper"] * 10_000 / 60)
    assert "a tiny size" in capsys.readouterr().out


def test_steps_are_those_after_the_warm_up(monkeypatch, as_it_was):
    """And every process has a batch for each of them."""
    seen = []
    fit = paper_size.Trainer.fit

    def note(trainer, module, data):
        seen.append((trainer.max_steps, module.schedule.steps, len(data.train_dataloader())))
        return fit(trainer, module, data)

    monkeypatch.setattr(paper_size.Trainer, "fit", note)
    monkeypatch.setattr(paper_size, "inference", lambda *_: [])
    monkeypatch.setattr(paper_size, "WARM_UP", 1)
    monkeypatch.setattr(paper_size, "print_table", lambda _, __, results: seen.append(len(results[1].values)))
    assert paper_size.main(["--device", "cpu", "--steps", "3", "--category", "eyeglasses"]) == 0
    assert seen == [(4, 4, 4), 3]
