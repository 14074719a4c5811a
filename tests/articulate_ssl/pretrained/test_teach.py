"""Shipped weights learn again what comes after training; their card says so, and what is finished is not repeated."""

import json
import shlex
from dataclasses import replace

import pytest
from packable import made_up_metrics, shipped_in, trained
from synthetic import write_synthetic_set

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.pretrained import stages, teach
from articulate_ssl.pretrained.teach import Teaching
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.lessons import LESSONS
from articulate_ssl.training.weights_card import WeightsCard
from articulate_ssl.training.weights_file import write_weights

COMMAND = "python -m render.generate --category laptop --seed 11 --train-instances 3"


@pytest.fixture
def shipped(tmp_path):
    """Weights of a tiny module that was not taught, with a card."""
    return shipped_in(tmp_path, trained(tmp_path), COMMAND)


@pytest.fixture
def made(monkeypatch):
    """Commands of the data that were made."""
    commands = []

    def run(command, log, _lock, _tick):
        log.write_text("")
        commands.append(shlex.join(command))
        write_synthetic_set(command[command.index("--out") + 1])
        return 0

    monkeypatch.setattr(stages, "run_program", run)
    return commands


@pytest.fixture
def learnt(monkeypatch):
    """Lessons that were taught."""
    lessons = []
    plain = teach.teach

    def noted(module, clouds, some):
        lessons.extend(some)
        if "interrupt" in lessons:
            raise KeyboardInterrupt
        plain(module, clouds, some)

    monkeypatch.setattr(teach, "teach", noted)
    return lessons


def test_lessons_are_taught_in_their_order_by_the_cards_data_and_tested(shipped, tmp_path, made, learnt):
    out = tmp_path / "out"
    before = shipped.file.read_bytes()
    teaching = Teaching(shipped, ("confidence", "joint_limits"), tmp_path / "build", out)
    card = teaching.run(print)
    assert learnt == ["joint_limits", "confidence"]
    assert made[0].split(" -m ", 1)[1].startswith(COMMAND.split(" -m ", 1)[1])
    assert card.training["commit"].startswith("abc; joint_limits, confidence by ")
    assert card.metrics["samples"] == 16 and card.metrics["r_err_deg"] != made_up_metrics()["r_err_deg"]
    assert card.weaknesses != ["none"] and card == WeightsCard.load(out / "laptop-complete.json")
    assert load_module(out / "laptop-complete.safetensors").confidence.learnt
    assert shipped.file.read_bytes() == before


def test_what_was_cut_off_goes_on_and_other_weights_begin_anew(shipped, tmp_path, made, learnt):
    build = tmp_path / "build"
    learnt.append("interrupt")
    with pytest.raises(KeyboardInterrupt):
        Teaching(shipped, LESSONS, build, tmp_path / "out").run(print)
    learnt.clear()
    Teaching(shipped, ("joint_limits",), build, tmp_path / "out").run(print)
    Teaching(shipped, LESSONS, build, tmp_path / "out").run(print)
    assert sorted(learnt) == sorted(LESSONS) and learnt[0] == "joint_limits" and len(made) == 1
    note = json.loads((build / "laptop-complete" / "lessons.json").read_text())
    assert sorted(note["done"]) == sorted(LESSONS)
    learnt.clear()
    write_weights(load_module(tmp_path / "out" / "laptop-complete.safetensors"), shipped.file)
    Teaching(shipped, ("confidence",), build, tmp_path / "out").run(print)
    assert learnt == ["confidence"]


def test_lessons_that_there_are_not_are_named(shipped, tmp_path):
    with pytest.raises(CheckpointError, match="astronomy: no such lesson; there are first_limits, two_ways"):
        Teaching(shipped, ("astronomy",), tmp_path)


def test_other_data_take_the_place_of_the_cards(shipped, tmp_path, made, learnt):
    data = ("--train-instances", "5", "--test-instances", "4", "--states", "2")
    build, out = tmp_path / "build", tmp_path / "out"
    Teaching(shipped, ("confidence",), build, out).run(print)
    card = Teaching(shipped, ("confidence",), build, out, data).run(print)
    told = "--seed 11 --train-instances 5 --test-instances 4 --states 2"
    assert told in made[1] and card.data["command"].endswith(told)
    assert (card.data["train_instances"], card.data["test_instances"], card.data["seed"]) == (5, 4, 11)
    assert learnt == ["confidence"] * 2  # nothing that other clouds taught is taken for taught
    with pytest.raises(CheckpointError, match="--states: options of the generator come with a value each"):
        Teaching(shipped, ("confidence",), build, out, ("--states",))


def test_scans_that_taught_views_are_made_as_the_card_says_and_are_at_hand(shipped, tmp_path, made, monkeypatch):
    file = shipped.file.with_suffix(".json")
    card = WeightsCard.load(file)
    scans = "python -m render.generate --category laptop --seed 10 --states 9"
    replace(card, data=card.data | {"scans": scans}).save(file)
    given = []
    monkeypatch.setattr(teach, "teach", lambda module, clouds, some: given.append(clouds.data.hparams.scans))
    Teaching(shipped, ("closed_doors",), tmp_path / "build", tmp_path / "out").run(print)
    assert [command.split(" --workers", 1)[0].split(" -m ", 1)[1] for command in made] == [
        COMMAND.split(" -m ", 1)[1],
        scans.split(" -m ", 1)[1],
    ]
    place = tmp_path / "build" / "laptop-complete"
    assert given == [str(place / "scans" / "laptop" / "procedural-complete")]
    assert (place / "scans" / "laptop" / "procedural-complete" / "manifest.json").is_file()
