"""A workplace with a trained checkpoint, and the command line in this process, for `test_learn` and `test_main`."""

from __future__ import annotations

import sys

import pytest
import yaml
from synthetic import write_synthetic_set
from tiny import NETWORK, POINTS, fit, tiny_module

from articulate_ssl.cli import main


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with a data set, a configuration and a trained checkpoint."""
    folder = tmp_path_factory.mktemp("cli")
    write_synthetic_set(folder)
    config = {
        "data": {"category": "laptop", "root": str(folder), "num_points": POINTS, "batch_size": 4},
        "model": {
            "num_parts": 2,
            "calibration_samples": 8,
            "network": {k: getattr(NETWORK, k) for k in NETWORK.__dataclass_fields__},
        },
        "trainer": {"max_steps": 1, "accelerator": "cpu", "default_root_dir": str(folder / "runs")},
    }
    (folder / "laptop.yaml").write_text(yaml.safe_dump(config))
    module = tiny_module(recipe="paper")
    fit(module, folder, 1).save_checkpoint(folder / "trained.ckpt")
    return folder


@pytest.fixture
def run(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(sys, "argv", ["lightning"])

    def run(*arguments) -> tuple[int, str]:
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as error:  # jsonargparse refuses arguments so
            code = error.code
        return code, capsys.readouterr().err

    return run
