"""What is done where the command line of `lightning fit|validate|test` does not say."""

import os

import pytest
import yaml

from articulate_ssl.cli import unsaid
from articulate_ssl.cli.unsaid import CPU_PROFILE, completed
from articulate_ssl.inference.checkpoint_file import CheckpointError


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A machine without an accelerator, with a category and a profile."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(unsaid, "accelerator_available", lambda: False)
    (tmp_path / "oven.yaml").write_text("data: {num_points: 512}")
    (tmp_path / "smoke.yaml").write_text("trainer: {max_steps: 3}")
    return tmp_path


def run(folder, name: str, age: int, checkpoint: str = "last.ckpt"):
    """A run of so many seconds ago."""
    path = folder / "runs" / name / "lightning_logs" / "version_0" / "checkpoints" / checkpoint
    path.parent.mkdir(parents=True)
    path.touch()
    os.utime(path, (1e9 - age, 1e9 - age))
    (path.parent.parent / "config.yaml").write_text("trainer: {accelerator: cpu}")
    return path.relative_to(folder)


@pytest.mark.parametrize(
    "given",
    [["-c", "oven.yaml"], ["--config", "oven.yaml"], ["--config=oven.yaml"], ["-c=oven.yaml"], ["-coven.yaml"]],
    ids=str,
)
@pytest.mark.parametrize("command", ["fit", "validate", "test"])
def test_the_cpu_profile_goes_between_the_category_and_what_is_typed_behind_it(command, given):
    words, notes = completed([command, *given, "-c", "smoke.yaml", "--data.seed", "3"])
    assert words == [command, *given, "-c", str(CPU_PROFILE), "-c", "smoke.yaml", "--data.seed", "3"]
    assert len(notes) == 1 and "cpu.yaml" in notes[0] and "paper.yaml" in notes[0]


def test_without_a_category_file_the_profile_comes_first():
    words, _ = completed(["fit", "--data.category", "oven"])
    assert words == ["fit", "-c", str(CPU_PROFILE), "--data.category", "oven"]


@pytest.mark.parametrize("option", [["--trainer.accelerator", "auto"], ["--trainer.accelerator=cpu"]], ids=str)
def test_an_accelerator_that_is_named_leaves_everything_as_it_was_typed(option):
    words = ["fit", "-c", "oven.yaml", *option]
    assert completed(words) == (words, [])


@pytest.mark.parametrize("profile", ["paper", "cpu", "gpu"])
def test_a_profile_that_names_an_accelerator_does_too(profile):
    path = CPU_PROFILE.resolve().with_name(f"{profile}.yaml")
    words = ["fit", "-c", "oven.yaml", "-c", str(path)]
    assert completed(words) == (words, [])


def test_nothing_is_added_on_a_machine_with_an_accelerator(monkeypatch):
    monkeypatch.setattr(unsaid, "accelerator_available", lambda: True)
    words = ["fit", "-c", "oven.yaml"]
    assert completed(words) == (words, [])


@pytest.mark.parametrize("words", [[], ["--help"], ["fit", "--help"], ["predict", "scan.ply"]], ids=str)
def test_other_commands_and_questions_for_help_are_left_alone(words):
    assert completed(words) == (words, [])


def test_a_file_that_there_is_not_is_left_to_the_parser():
    assert completed(["fit", "-c", "nowhere.yaml"]).words[:3] == ["fit", "-c", "nowhere.yaml"]


@pytest.mark.parametrize("command", ["validate", "test"])
def test_without_a_configuration_the_newest_run_is_taken(folder, command):
    run(folder, "laptop", age=60)
    newest = run(folder, "oven", age=5)
    run(folder, "safe", age=30)
    words, (note,) = completed([command, "--data.seed", "3"])
    config = newest.parent.parent / "config.yaml"
    assert words == [command, "-c", str(config), "--ckpt_path", str(newest), "--data.seed", "3"]
    assert str(config) in note and newest.name in note


def test_of_a_checkpoint_that_is_named_its_own_run_is_taken(folder):
    older = run(folder, "laptop", age=60)
    run(folder, "oven", age=5)
    words, (note,) = completed(["test", f"--ckpt_path={older}"])
    assert words == ["test", "-c", str(older.parent.parent / "config.yaml"), f"--ckpt_path={older}"]
    assert "laptop" in note


def test_a_run_elsewhere_is_found_where_the_root_is_named(folder):
    run(folder, "oven", age=5)
    elsewhere = run(folder / "else", "safe", age=60)
    words, _ = completed(["test", "--trainer.default_root_dir", "else"])
    assert words[2] == str("else" / elsewhere.parent.parent / "config.yaml")


def test_no_run_and_a_checkpoint_without_its_run_are_refused(folder):
    with pytest.raises(CheckpointError, match="no checkpoint under runs; run `lightning fit"):
        completed(["test"])
    (folder / "mine.ckpt").touch()
    with pytest.raises(CheckpointError, match=r"mine\.ckpt: no configuration of its run"):
        completed(["test", "--ckpt_path", "mine.ckpt"])


def test_the_installed_profile_is_that_of_the_repository():
    profile = CPU_PROFILE.parents[2] / "configs" / "profiles" / "cpu.yaml"
    assert CPU_PROFILE.read_bytes() == profile.read_bytes()
    assert yaml.safe_load(CPU_PROFILE.read_text())["trainer"]["accelerator"] == "cpu"


@pytest.mark.parametrize("content", ["", "- a", "data: {", "a:\n\tb: 1", b"\x9e\x00"], ids=repr)
def test_a_file_that_is_no_configuration_is_named(folder, content):
    (folder / "mine.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=r"mine\.yaml"):
        completed(["fit", "-c", "oven.yaml", "-c", "smoke.yaml", "-c", "mine.yaml"])
