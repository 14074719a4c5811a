"""Exit codes and messages of `lightning fit|validate|test`, in this process."""

import json

import numpy as np
import pytest
import torch
from refusal import refused

from articulate_ssl.cli import main
from articulate_ssl.training.checkpoint import load_module


def test_a_test_without_a_checkpoint_is_refused(run):
    refused(run("test", "-c", "laptop.yaml"), "no checkpoint", "lightning fit")


def test_a_missing_or_truncated_checkpoint_is_refused(run, workplace):
    refused(run("test", "-c", "laptop.yaml", "--ckpt_path", "nowhere.ckpt"), "nowhere.ckpt")
    content = (workplace / "trained.ckpt").read_bytes()
    (workplace / "cut.ckpt").write_bytes(content[: len(content) // 2])
    refused(run("test", "-c", "laptop.yaml", "--ckpt_path", "cut.ckpt"), "cut.ckpt", "damaged")


@pytest.mark.parametrize("command", ["fit", "test", "validate"])
def test_a_checkpoint_of_another_category_is_refused(run, workplace, command):
    content = torch.load(workplace / "trained.ckpt", weights_only=True)
    content["hyper_parameters"]["category"] = "oven"
    torch.save(content, workplace / "oven.ckpt")
    refused(run(command, "-c", "laptop.yaml", "--ckpt_path", "oven.ckpt"), "oven.ckpt", "'oven'", "'laptop'")


@pytest.mark.parametrize("key", ["--model.network.group_ordr=12", "--model.recpie=paper", "--data.batchsize=3"])
def test_a_misspelt_key_is_refused(run, key):
    refused(run("fit", "-c", "laptop.yaml", key), key.split("=")[0].split(".")[-1])


def test_a_misspelt_key_in_a_file_is_refused(run, workplace):
    (workplace / "bad.yaml").write_text("model:\n  objective:\n    joint_regularisation: 0\n")
    refused(run("fit", "-c", "laptop.yaml", "-c", "bad.yaml"), "joint_regularisation")


def test_an_impossible_value_is_refused(run):
    refused(run("fit", "-c", "laptop.yaml", "--model.recipe=magic"), "recipe")
    refused(run("fit", "-c", "laptop.yaml", "--model.network.group_order=13"), "rotation group")


def test_missing_data_are_refused_with_the_command_that_makes_them(run, tmp_path):
    refused(run("fit", "-c", "laptop.yaml", f"--data.root={tmp_path}"), "make data CAT=laptop")


def test_a_test_writes_its_metrics(run, workplace):
    code, _ = run("test", "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.recipe=paper")
    assert code == 0
    found = list((workplace / "runs").rglob("metrics.json"))
    assert len(found) == 1
    assert {p.name for p in found[0].parent.iterdir()} >= {"metrics.json", "metrics.csv", "test_samples.png"}
    metrics = json.loads(found[0].read_text())
    statistics = ("r_err_deg", "t_err", "axis_err_deg", "pivot_err", "state_err", "seg_miou", "chamfer_l1", "flip_rate")
    for name in (*statistics, "legacy_r_err_deg"):
        assert {"mean", "median", "ci95"} <= set(metrics[name]), name
    assert metrics["samples"] > 0 and metrics["failures"] == 0
    for name in ("protocol", "category", "source", "checkpoint", "seconds_per_cloud"):
        assert name in metrics


def test_a_separable_network_trains_from_the_command_line(run, workplace):
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--model.network.separable", "true")
    assert run(*command, f"--trainer.default_root_dir={workplace / 'separable'}")[0] == 0
    (checkpoint,) = (workplace / "separable").rglob("last.ckpt")
    content = torch.load(checkpoint, weights_only=True)
    assert content["global_step"] == 1
    assert "articulated.backbone.blocks.1.spatial" in content["state_dict"]
    assert load_module(checkpoint).hparams["network"]["separable"]


def test_a_network_on_directions_trains_from_the_command_line(run, workplace):
    sizes = ("--model.network.directions", "true", "--model.network.group_order", "60")
    folder = f"--trainer.default_root_dir={workplace / 'directions'}"
    assert run("fit", "-c", "laptop.yaml", "--model.recipe=paper", *sizes, folder)[0] == 0
    (checkpoint,) = (workplace / "directions").rglob("last.ckpt")
    assert "articulated.pointnet.to_group" in torch.load(checkpoint, weights_only=True)["state_dict"]
    assert load_module(checkpoint).hparams["network"]["directions"]


def test_a_checkpoint_older_than_an_option_is_one_with_its_default(run, workplace):
    content = torch.load(workplace / "trained.ckpt", weights_only=True)
    del content["hyper_parameters"]["network"]["directions"]
    torch.save(content, workplace / "older.ckpt")
    assert run("validate", "-c", "laptop.yaml", "--ckpt_path", "older.ckpt", "--model.recipe=paper")[0] == 0


def test_a_checkpoint_of_other_network_sizes_is_refused(run):
    command = ("test", "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.network.head_dim=16")
    refused(run(*command), "trained.ckpt", "network sizes")


def test_another_range_of_orientations_than_in_training_is_refused(run):
    command = ("test", "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.recipe=paper")
    refused(run(*command, "--model.orientation_range=90"), "trained.ckpt", "orientation_range 180")


def test_a_range_of_orientations_is_remembered_and_told(run, workplace, capsys):
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--model.orientation_range=90")
    assert run(*command, f"--trainer.default_root_dir={workplace / 'upright'}")[0] == 0
    (checkpoint,) = (workplace / "upright").rglob("last.ckpt")
    assert load_module(checkpoint).orientation.degrees == 90
    np.save(workplace / "upright.npy", np.random.default_rng(0).normal(size=(500, 3)))
    main(["predict", "upright.npy", "--ckpt", str(checkpoint), "--out", "upright-result"])
    assert "y down" in capsys.readouterr().out
