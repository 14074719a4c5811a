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


@pytest.mark.parametrize("command", cli.COMMANDS.values())
def test_every_command_can_be_run(command):
    assert callable(import_module(command.module).run)


def test_a_command_is_a_module_that_the_table_names(run, monkeypatch):
    given = []
    monkeypatch.setitem(sys.modules, "toy_command", types.SimpleNamespace(run=lambda words: given.append(words) or 7))
    monkeypatch.setitem(cli.COMMANDS, "toy", cli.Command("toy_command", "toys"))
    assert run("toy", "--fast", "car") == (7, "")
    assert given == [["toy", "--fast", "car"]]


@pytest.mark.parametrize("arguments", [[], ["bogus"]])
def test_an_unknown_command_is_refused_with_those_that_there_are(run, arguments):
    refused(run(*arguments), "predict, twin, view, weights, fit, validate, test", *arguments)


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_help_names_every_command(word, capsys):
    assert cli.main([word]) == 0
    said = capsys.readouterr().out
    assert all(f"\n  {name} " in said for name in cli.COMMANDS)
    assert max(map(len, said.splitlines())) <= 100


def test_options_before_the_command_are_for_lightnings_parser(run):
    refused(run("--bogus"), "fit,validate,test")


def test_the_package_can_be_run(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lightning", "predict", "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("articulate_ssl.cli", run_name="__main__")
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("usage: articulate-ssl predict ")


@pytest.mark.parametrize(
    "words", ["--help", "predict --help", "twin --help", "view --help", "weights --help", "weights list", "bogus"]
)
def test_what_computes_nothing_waits_for_no_import(words):
    """PyTorch alone takes seconds, Lightning as long again."""
    program = f"""if True:
        import sys
        from articulate_ssl.cli import main
        try:
            main({words.split()})
        finally:
            slow = {{"torch", "lightning", "trimesh", "scipy", "huggingface_hub", "matplotlib"}} & set(sys.modules)
            assert not slow, slow
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_bad_cloud_is_refused_before_the_networks_are_imported(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros((5, 2)))
    program = f"""if True:
        import sys
        from articulate_ssl.cli import main
        code = main(["predict", {str(tmp_path / "flat.npy")!r}, "--category", "laptop"])
        assert code == 2 and "torch" not in sys.modules, code
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "flat.npy" in done.stderr


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
