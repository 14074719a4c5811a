"""`make weights` does every stage once, goes on where it was killed, and never mixes two commands' results."""

import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from articulate_ssl.pretrained import rebuild as module
from articulate_ssl.pretrained.rebuild import CATEGORIES, Rebuild, StageFailed, commit_of, rebuild
from render.generate import _parser


class Programs:
    """Stands in for the programs of the stages: keeps their commands, leaves what they would."""

    def __init__(self, place: Path) -> None:
        self.place, self.commands, self.fails = place, [], None

    def __call__(self, command, **_):
        name = next(word for word in ("fit", "test", "render.generate") if word in command)
        self.commands.append((name, list(command)))
        if name == "render.generate":
            (self.place / "data").mkdir(exist_ok=True)
        if name == "fit":
            folder = self.place / "run" / "checkpoints"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "last.ckpt").touch()
        if self.fails == name:
            return SimpleNamespace(returncode=1)
        if self.fails == f"{name} killed":
            raise KeyboardInterrupt
        if name == "test":
            (self.place / "run" / "metrics.json").write_text("{}")
        return SimpleNamespace(returncode=0)

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.commands]


@pytest.fixture
def plan(tmp_path) -> Rebuild:
    return Rebuild("oven", "depth", tmp_path / "build", tmp_path / "weights")


@pytest.fixture
def programs(plan, monkeypatch):
    programs = Programs(plan.place)
    monkeypatch.setattr(module, "subprocess", SimpleNamespace(run=programs, STDOUT=subprocess.STDOUT))
    monkeypatch.setattr(module, "commit_of", lambda _folder: "abc")

    def pack(metrics, commit, folder):
        folder.mkdir(exist_ok=True)
        for suffix in (".safetensors", ".json"):
            (folder / f"oven-depth{suffix}").touch()

    monkeypatch.setattr(module, "pack", pack)
    return programs


def test_all_stages_run_once_and_their_data_are_deleted(plan, programs):
    said = []
    plan.run(said.append)
    assert programs.names == ["render.generate", "fit", "test"]
    assert said[-1] == "oven-depth: packed" and not plan.data_root.exists()
    plan.run(said.append)
    assert len(programs.commands) == 3 and said[-1] == "oven-depth: done before"


def test_after_a_kill_only_what_is_missing_runs_and_the_fit_goes_on(plan, programs):
    programs.fails = "fit killed"
    with pytest.raises(KeyboardInterrupt):
        plan.run(print)
    programs.fails = None
    plan.run(print)
    assert programs.names == ["render.generate", "fit", "fit", "test"]
    first, second = (command for name, command in programs.commands if name == "fit")
    assert "--ckpt_path" not in first
    assert second == [*first, "--ckpt_path", str(plan.place / "run" / "checkpoints" / "last.ckpt")]


def test_weights_that_were_deleted_are_packed_again_without_training(plan, programs):
    plan.run(print)
    shutil.rmtree(plan.folder)
    plan.run(print)
    assert programs.names == ["render.generate", "fit", "test", "render.generate"]


def test_another_seed_does_everything_anew(plan, programs, monkeypatch):
    plan.run(print)
    monkeypatch.setattr(module, "DATA_SEED", 99)
    plan.run(print)
    assert programs.names == ["render.generate", "fit", "test"] * 2
    assert "--ckpt_path" not in programs.commands[4][1]


def test_another_fit_does_not_go_on_from_what_is_there(plan, programs, monkeypatch):
    programs.fails = "fit killed"
    with pytest.raises(KeyboardInterrupt):
        plan.run(print)
    monkeypatch.setattr(module, "FIT_SEED", 5)
    programs.fails = None
    plan.run(print)
    assert programs.names == ["render.generate", "fit", "fit", "test"]
    assert "--ckpt_path" not in programs.commands[2][1]


def test_a_failure_names_the_log_and_does_not_stop_the_others(plan, programs):
    programs.fails = "test"
    with pytest.raises(StageFailed, match=r"oven-depth: test failed with exit code 1; .*test\.log"):
        plan.run(print)
    said = []
    failed = rebuild(plan.build, said.append, ["oven"], ["depth"], plan.folder)
    assert len(failed) == 1 and failed[0] in said


@pytest.mark.parametrize("view", ["complete", "depth"])
@pytest.mark.parametrize("category", CATEGORIES)
def test_every_command_is_one_that_its_program_takes(tmp_path, category, view):
    data, fit, test = Rebuild(category, view, tmp_path).stages()
    options = _parser().parse_args(data.command[3:])
    assert options.category == category and options.view == {"complete": "complete", "depth": "partial"}[view]
    assert [stage.command[3] for stage in (fit, test)] == ["fit", "test"]
    assert fit.command[4:] == test.command[4:]


def test_the_commit_is_that_of_the_folder(tmp_path):
    assert len(commit_of(Path(__file__).parent).rstrip("+")) == 40
    assert commit_of(tmp_path) == "unknown"
