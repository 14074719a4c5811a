"""`make weights` does every stage once, goes on where it was killed, and never mixes two commands' results."""

import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from articulate_ssl.discovery.one_object.find import MIN_CLOUDS
from articulate_ssl.pretrained import rebuild as module
from articulate_ssl.pretrained import stages
from articulate_ssl.pretrained.pack import MULTI_STATE_PROFILE
from articulate_ssl.pretrained.rebuild import (
    CATEGORIES,
    MULTI_STATE,
    Rebuild,
    Stage,
    StageFailed,
    commit_of,
    rebuild,
)
from datamodules.manifest import set_folder
from render.generate import _parser


class Programs:
    """Stands in for the programs of the stages: keeps their commands, leaves what they would."""

    def __init__(self, place: Path) -> None:
        self.place, self.commands, self.fails = place, [], None

    def __call__(self, command, log, lock, tick):
        name = next(word for word in ("fit", "test", "render.generate") if word in command)
        self.commands.append((name, list(command)))
        if name == "render.generate":
            (self.place / "data").mkdir(exist_ok=True)
        if name == "fit":
            folder = self.place / "run" / "checkpoints"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "last.ckpt").touch()
        if self.fails == name:
            return 1
        if self.fails == f"{name} killed":
            raise KeyboardInterrupt
        if name == "test":
            (self.place / "run" / "metrics.json").write_text("{}")
        return 0

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.commands]


@pytest.fixture
def plan(tmp_path, monkeypatch) -> Rebuild:
    """Of one stage a kind, whichever sets scans teach."""
    monkeypatch.setattr(module, "MULTI_STATE", ())
    return Rebuild("oven", "depth", tmp_path / "build", tmp_path / "weights")


@pytest.fixture
def programs(plan, monkeypatch):
    programs = Programs(plan.place)
    monkeypatch.setattr(stages, "run_program", programs)
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


def test_weights_of_before_are_not_taken_for_new_ones(plan, programs):
    """As in the package, which has weights of every name."""
    plan.folder.mkdir()
    for suffix in (".safetensors", ".json"):
        (plan.folder / f"oven-depth{suffix}").write_text("old")
    programs.fails = "test killed"
    with pytest.raises(KeyboardInterrupt):
        plan.run(print)
    programs.fails = None
    said = []
    plan.run(said.append)
    assert said[-1] == "oven-depth: packed" and programs.names == ["render.generate", "fit", "test", "test"]


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
    *_, data, fit, test = Rebuild(category, view, tmp_path).stages()
    options = _parser().parse_args(data.command[3:])
    assert options.category == category and options.view == {"complete": "complete", "depth": "partial"}[view]
    assert [stage.command[3] for stage in (fit, test)] == ["fit", "test"]
    assert fit.command[4:] == test.command[4:]


@pytest.mark.parametrize(("category", "view"), MULTI_STATE)
def test_objects_in_the_multi_state_setting_have_clouds_enough(tmp_path, category, view):
    """Where views are taught by scans, the scans; and the fit finds them."""
    first, *_, fit, test = Rebuild(category, view, tmp_path).stages()
    options = _parser().parse_args(first.command[3:])
    assert options.states >= MIN_CLOUDS and options.view == "complete"
    assert any(profile in fit.command for profile in MULTI_STATE_PROFILE.values())
    scans = set_folder(str(options.out), category, "procedural", "complete", None)
    for command in (fit.command, test.command):
        assert ("--data.scans" in command) == (view == "depth") == (str(scans) in command)


def test_other_weights_are_of_single_clouds(tmp_path):
    fit = Rebuild("laptop", "complete", tmp_path).stages()[1]
    assert not any(profile in fit.command for profile in MULTI_STATE_PROFILE.values())


def test_the_commit_is_that_of_the_folder(tmp_path):
    assert len(commit_of(Path(__file__).parent).rstrip("+")) == 40
    assert commit_of(tmp_path) == "unknown"


# Notes when it starts and ends, leaves what its stage leaves, and takes its time where it is told to.
PROGRAM = """
import json, sys, time
from pathlib import Path

stage, place, *options = sys.argv[1:]
place = Path(place)

def note(what):
    with (place / "events.txt").open("a") as file:
        file.write(json.dumps([stage, what, options]) + "\\n")

note("begins")
if stage == "data":
    (place / "data").mkdir(exist_ok=True)
elif stage == "fit":
    (place / "run" / "checkpoints").mkdir(parents=True, exist_ok=True)
    (place / "run" / "checkpoints" / "last.ckpt").touch()
if (place.parent / f"slow {stage}").exists():
    (place.parent / f"slow {stage}").unlink()
    time.sleep(float(sys.argv[3]))
elif stage == "test":
    (place / "run" / "metrics.json").write_text("{}")
note("ends")
"""


class Little(Rebuild):
    """A rebuild whose programs do nothing, for `seconds` where a file says which is to be slow."""

    seconds = 60.0

    def stages(self) -> tuple[Stage, ...]:
        return tuple(
            Stage(name, (sys.executable, "-c", PROGRAM, name, str(self.place), str(self.seconds)))
            for name in ("data", "fit", "test")
        )

    def events(self) -> list[list]:
        lines = (self.place / "events.txt").read_text().splitlines() if self.place.is_dir() else []
        return [json.loads(line) for line in lines]


def slow_pack(metrics: Path, commit: str, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "oven-depth.safetensors").write_text("new")
    slow = metrics.parents[2] / "slow pack"
    if slow.exists():
        slow.unlink()
        time.sleep(60)
    (folder / "oven-depth.json").write_text("new")


@pytest.fixture
def little(tmp_path, monkeypatch) -> Little:
    monkeypatch.setattr(module, "pack", slow_pack)
    (tmp_path / "build").mkdir()
    return Little("oven", "depth", tmp_path / "build", tmp_path / "weights")


def run_and_kill(plan: Little, stage: str, everything: bool) -> None:
    """Kill -9 in the midst of a stage: the rebuild with its program, or the rebuild alone."""
    slow = plan.build / f"slow {stage}"
    slow.touch()

    def work() -> None:
        os.setsid()
        plan.run(print)

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    while slow.exists():
        assert process.is_alive()
        time.sleep(0.01)
    (os.killpg if everything else os.kill)(process.pid, signal.SIGKILL)
    process.join()


@pytest.mark.parametrize("stage", ["data", "fit", "test", "pack"])
def test_after_kill_9_in_any_stage_it_goes_on_with_that_stage(little, stage):
    run_and_kill(little, stage, everything=True)
    said = []
    little.run(said.append)
    begun = [(name, "--ckpt_path" in options) for name, what, options in little.events() if what == "begins"]
    assert (
        begun
        == {
            "data": [("data", False), ("data", False), ("fit", False), ("test", False)],
            "fit": [("data", False), ("fit", False), ("fit", True), ("test", False)],
            "test": [("data", False), ("fit", False), ("test", False), ("test", False)],
            "pack": [("data", False), ("fit", False), ("test", False)],
        }[stage]
    )
    assert said[-1] == "oven-depth: packed" and not little.data_root.exists()
    assert [file.read_text() for file in little.folder.iterdir()] == ["new", "new"]


def test_a_program_that_outlives_a_killed_rebuild_is_waited_for(little, monkeypatch):
    monkeypatch.setattr(Little, "seconds", 1.0)
    run_and_kill(little, "fit", everything=False)
    said = []
    little.run(said.append)
    assert "waiting" in said[1] and said[-1] == "oven-depth: packed"
    fits = [what for name, what, _ in little.events() if name == "fit"]
    assert fits == ["begins", "ends"] * 2  # one after the other


def test_data_that_were_half_deleted_are_not_taken_for_data(little, monkeypatch):
    class Killed(BaseException):
        pass

    def delete(folder, **_):
        if Path(folder).is_dir():
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(module.shutil, "rmtree", delete)
        little.place.mkdir()
        (little.place / "run").mkdir(parents=True)
        (little.place / "data").mkdir()
        with pytest.raises(Killed):
            little._delete_data()
    assert not little.data_root.exists()
    little.run(print)
    assert [file.name for file in little.place.glob("*/") if file.name in ("data", "deleted")] == []
