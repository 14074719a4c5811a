"""Exit codes and messages of `lightning fit|validate|test`, in this process."""

import json
import os
import signal
import sys

import numpy as np
import pytest
import torch
import yaml
from refusal import refused

from articulate_ssl.cli import learn, main, unsaid
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.module import ArticulatedPoseModule


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
    assert {p.name for p in found[0].parent.iterdir()} >= {
        *("metrics.json", "metrics.csv", "objects.csv", "test_samples.png")
    }
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


def test_the_last_checkpoint_of_a_run_is_of_its_last_step(run, workplace, monkeypatch):
    """Also where the steps are no multiple of those between checkpoints: 2 and 5."""
    monkeypatch.setattr(learn, "_CHECKPOINT_STEPS", 2)
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--trainer.max_steps=5")
    assert run(*command, f"--trainer.default_root_dir={workplace / 'five'}")[0] == 0
    (checkpoint,) = (workplace / "five").rglob("last.ckpt")
    assert torch.load(checkpoint, weights_only=True)["global_step"] == 5
    assert load_module(checkpoint).confidence.learnt


def test_a_run_that_was_terminated_did_not_succeed(run, workplace, monkeypatch):
    """Lightning lets it end with exit code 0."""
    step = ArticulatedPoseModule.training_step

    def terminated(module, *arguments):
        os.kill(os.getpid(), signal.SIGTERM)
        return step(module, *arguments)

    monkeypatch.setattr(ArticulatedPoseModule, "training_step", terminated)
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--trainer.max_steps=3")
    code, said = run(*command, f"--trainer.default_root_dir={workplace / 'terminated'}")
    assert code == learn.TERMINATED == 143 and "terminated" in said


def test_a_checkpoint_of_other_network_sizes_is_refused(run):
    command = ("test", "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.network.head_dim=16")
    refused(run(*command), "trained.ckpt", "network sizes")


def test_another_range_of_orientations_than_in_training_is_refused(run):
    command = ("test", "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.recipe=paper")
    refused(run(*command, "--model.orientation_range=90"), "trained.ckpt", "orientation_range 180")


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--model.num_parts=3", "num_parts 2, not 3"),
        ("--model.joint_type=prismatic", "joint_type revolute, not prismatic"),
        ("--model.state_range=0.2", "not 0.2"),
        ("--model.schedule.rigid_steps=1", "schedule.rigid_steps 0, not 1"),
        ("--model.recipe=staged", "recipe paper, not staged"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "test"])
def test_a_checkpoint_of_another_model_is_refused(run, command, option, words):
    given = (command, "-c", "laptop.yaml", "--ckpt_path", "trained.ckpt", "--model.recipe=paper", option)
    refused(run(*given), "trained.ckpt", words)


def test_parts_that_labels_do_not_have_are_told_in_training_and_refused_in_the_test(run, workplace):
    root = f"--trainer.default_root_dir={workplace / 'three'}"
    options = ("-c", "laptop.yaml", "--model.recipe=paper", "--model.num_parts=3", root)
    code, said = run("fit", *options)
    assert code == 0 and "labels have 2 parts, and --model.num_parts is 3" in said
    refused(run("test", *options), "procedural-complete", "labels have 2 parts")


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--trainer.accelerator=gpu", "No supported gpu backend"),
        ("--trainer.enable_checkpointing=false", "enable_checkpointing"),
        ("--trainer.default_root_dir=laptop.yaml", "laptop.yaml"),
        ("--model.schedule.decay_every=0", "schedule.decay_every is 0, must be at least 1"),
        ("--model.network.dims=[]", "network.dims"),
        ("--model.network.radii=[0,0]", "network.radii"),
        ("--model.state_range=-1", "state_range"),
        ("--model.pose_samples=-1", "pose_samples is -1, must be at least 0"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_it_begins(run, option, words):
    refused(run("fit", "-c", "laptop.yaml", "--model.recipe=paper", option), words)


def test_a_range_of_orientations_is_remembered_and_told(run, workplace, capsys):
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--model.orientation_range=90")
    assert run(*command, f"--trainer.default_root_dir={workplace / 'upright'}")[0] == 0
    (checkpoint,) = (workplace / "upright").rglob("last.ckpt")
    assert load_module(checkpoint).orientation.degrees == 90
    np.save(workplace / "upright.npy", np.random.default_rng(0).normal(size=(500, 3)))
    main(["predict", "upright.npy", "--ckpt", str(checkpoint), "--out", "upright-result"])
    assert "y down" in capsys.readouterr().out


@pytest.fixture
def without_gpu(monkeypatch):
    monkeypatch.setattr(unsaid, "accelerator_available", lambda: False)


def printed(capsys, *words) -> dict:
    """The configuration that a command would run with."""
    with pytest.raises(SystemExit):
        main([*words, "--print_config"])
    return yaml.safe_load(capsys.readouterr().out)


def test_without_a_gpu_the_cpu_profile_applies_and_what_is_typed_wins(workplace, without_gpu, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    (workplace / "big.yaml").write_text("{data: {category: laptop, num_points: 512}, model: {num_parts: 2}}")
    (workplace / "mine.yaml").write_text("{trainer: {max_steps: 7}}")
    (workplace / "whole.yaml").write_text("{trainer: {accelerator: auto}}")
    config = printed(capsys, "fit", "-c", "big.yaml", "-c", "mine.yaml", "--data.batch_size", "5")
    assert (config["data"]["num_points"], config["model"]["network"]["group_order"]) == (256, 12)
    assert (config["trainer"]["max_steps"], config["data"]["batch_size"]) == (7, 5)
    config = printed(capsys, "fit", "-c", "big.yaml", "-c", "whole.yaml")
    assert (config["data"]["num_points"], config["model"]["network"]["group_order"]) == (512, 60)


def test_what_was_added_is_told_in_one_line(run, workplace, without_gpu):
    (workplace / "big.yaml").write_text("{data: {category: laptop, root: nowhere}, model: {num_parts: 2}}")
    _, message = run("fit", "-c", "big.yaml")
    assert len([line for line in message.splitlines() if line.startswith("lightning fit: no GPU")]) == 1


def test_fit_then_test_without_any_option(run, workplace, capsys):
    """The run's own configuration is taken, with options that no file names, and nothing of wandb is left in it."""
    folder = f"--trainer.default_root_dir={workplace / 'runs' / 'bare'}"
    sizes = ("--model.network.head_dim=12", "--model.recipe=paper")
    assert run("fit", "-c", "laptop.yaml", *sizes, folder)[0] == 0
    refused(run("test", "-c", "laptop.yaml", folder), "other network sizes", "leave -c out")
    for command in ("test", "validate"):
        code, message = run(command)
        assert code == 0
        assert "newest run, checkpoint" in message and "bare/lightning_logs/version_0/config.yaml" in message
    assert len(list((workplace / "runs" / "bare").rglob("test_samples.png"))) == 1


def test_fit_says_how_long_it_will_take(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    command = ("fit", "-c", "laptop.yaml", "--model.recipe=paper", "--trainer.max_steps=22")
    assert main([*command, f"--trainer.default_root_dir={workplace / 'long'}"]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("lightning fit: ")]
    assert [line.split(" for ")[1].split(" (")[0] for line in told] == ["22 steps", "21 steps"]


@pytest.mark.parametrize("name", ["foo", "foo.pt", "foo.safetensors"])
@pytest.mark.parametrize("separator", [" ", "="])
def test_a_checkpoint_of_another_suffix_is_refused(run, workplace, name, separator):
    (workplace / name).write_bytes((workplace / "trained.ckpt").read_bytes())
    words = f"--ckpt_path{separator}{name}".split()
    refused(run("test", "-c", "laptop.yaml", *words), name, "not a .ckpt file")


def test_a_folder_of_checkpoints_is_refused_with_the_newest(run, workplace):
    refused(run("fit", "-c", "laptop.yaml", "--ckpt_path", "."), "a folder", ".ckpt")


def test_curves_and_pictures_go_to_weights_and_biases_if_asked_for(run, workplace, monkeypatch):
    """Without account and network."""
    import wandb

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    root = workplace / "with-wandb"
    options = (f"--trainer.default_root_dir={root}", "--model.recipe=paper", "--trainer.log_every_n_steps=1")
    for command, flag in (("fit", ["--wandb"]), ("test", ["--wandb", "mine"])):
        assert run(command, "-c", "laptop.yaml", *options, *flag)[0] == 0
        wandb.finish()
    wandb.teardown()  # not until then is everything written
    sent = [path.read_bytes() for path in root.glob("wandb/offline-run-*/run-*.wandb")]
    curves, results = sorted(sent, key=lambda content: b"test/seg_miou" in content)
    assert b"articulate-ssl" in curves and b"state_spread" in curves and b"mine" not in curves
    assert all(name in results for name in (b"mine", b"test/r_err_deg", b"test/seg_miou", b"test_samples"))
    assert len(list(root.glob("wandb/offline-run-*/files/media/images/*.png"))) == 1
    (config,) = root.glob("lightning_logs/version_0/config.yaml")  # the run's folder is where it was without the flag
    assert yaml.safe_load(config.read_text())["wandb"] is None


def test_what_weights_and_biases_refuses_is_told_in_one_line(run, workplace, monkeypatch):
    import wandb

    def init(**_):
        raise wandb.errors.UsageError("No API key configured. Use `wandb login` to log in.")

    monkeypatch.setattr(wandb, "init", init)
    folder = f"--trainer.default_root_dir={workplace / 'no-account'}"
    refused(run("fit", "-c", "laptop.yaml", "--model.recipe=paper", folder, "--wandb"), "wandb login", "WANDB_MODE")


def test_without_its_flag_nothing_of_wandb_is_imported_or_written(run, workplace, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)  # what imports it, fails
    folder = workplace / "no-wandb"
    assert run("fit", "-c", "laptop.yaml", "--model.recipe=paper", f"--trainer.default_root_dir={folder}")[0] == 0
    assert list(folder.rglob("last.ckpt")) and not list(folder.rglob("*wandb*"))
