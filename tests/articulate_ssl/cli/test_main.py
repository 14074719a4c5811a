"""The choice of the command, and `lightning predict` with a real checkpoint, in this process."""

import runpy
import subprocess
import sys
import types
from importlib import import_module

import numpy as np
import pytest
from refusal import refused

from articulate_ssl import cli


@pytest.mark.parametrize("module", [*cli.COMMANDS.values(), cli.OTHERWISE])
def test_every_command_can_be_run(module):
    assert callable(import_module(module).run)


def test_a_command_is_a_module_that_the_table_names(run, monkeypatch):
    given = []
    monkeypatch.setitem(sys.modules, "toy_command", types.SimpleNamespace(run=lambda words: given.append(words) or 7))
    monkeypatch.setitem(cli.COMMANDS, "toy", "toy_command")
    assert run("toy", "--fast", "car") == (7, "")
    assert given == [["toy", "--fast", "car"]]


@pytest.mark.parametrize("arguments", [[], ["bogus"]])
def test_an_unknown_command_is_refused_with_those_that_there_are(run, arguments):
    refused(run(*arguments), "fit,validate,test,predict")


def test_the_package_can_be_run(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lightning", "predict", "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("articulate_ssl.cli", run_name="__main__")
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("usage: lightning predict ")


def test_help_on_predict_needs_no_training_code():
    program = """if True:
        import sys
        from articulate_ssl.cli import main
        try:
            main(["predict", "--help"])
        finally:
            assert not {"lightning", "torchmetrics", "articulate_ssl.training.module"} & set(sys.modules)
    """
    assert subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL).returncode == 0


def test_a_missing_cloud_is_refused(run):
    refused(run("predict", "nowhere.ply", "--ckpt", "trained.ckpt"), "nowhere.ply")


@pytest.mark.parametrize(
    ("points", "problem"),
    [(np.full((500, 3), np.nan), "NaN"), (np.empty((0, 3)), "no points"), (np.ones((1, 3)), "one point")],
    ids=["NaN", "empty", "one point"],
)
def test_an_unusable_cloud_is_refused(run, workplace, points, problem):
    np.save(workplace / "bad.npy", points)
    refused(run("predict", "bad.npy", "--ckpt", "trained.ckpt"), "bad.npy", problem)
    assert not (workplace / "bad-prediction").exists()


def test_a_scan_gives_a_folder_of_results(run, workplace):
    np.save(workplace / "scan.npy", np.random.default_rng(0).normal(size=(500, 3)) * [30, 20, 2] + 100)
    assert run("predict", "scan.npy", "--ckpt", "trained.ckpt", "--out", "result")[0] == 0
    files = {p.name for p in (workplace / "result").iterdir()}
    assert files >= {"prediction.json", "parts.ply", "reconstruction.ply", "object.urdf", "picture.png"}
