"""What comes after the last step is taught once, in order, and goes on where it was cut off."""

import warnings

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from synthetic import write_synthetic_set
from tiny import quiet_trainer, tiny_data, tiny_module

from articulate_ssl.training.callbacks import lessons
from articulate_ssl.training.lessons import LESSONS, teach

STEPS = 5  # shapes are free in the last of them, as they are in longer trainings


class CutOffError(Exception):
    """As by a kill."""


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_synthetic_set(folder)
    return folder


@pytest.fixture
def taught(monkeypatch):
    """Lessons that came to their end, as if all applied; the one that stands in the first place before is cut off."""
    ends = []

    def noted(module, clouds, some):
        if ends[:1] == list(some):
            raise CutOffError
        teach(module, clouds, some)
        ends.extend(some)
        return tuple(some)

    monkeypatch.setattr(lessons, "teach", noted)
    return ends


def fit(root, folder, steps=STEPS, checkpoint=None, **options):
    """Train by the paper's recipe, which learns confidence and nothing else behind its last step."""
    module = tiny_module(steps, recipe="paper", network={"iterations": 1}, **options)
    last = ModelCheckpoint(folder, filename="{step}", every_n_train_steps=2, save_last=True)
    trainer = quiet_trainer(folder, max_steps=steps, callbacks=[last], enable_checkpointing=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(module, tiny_data(root), ckpt_path=checkpoint)
    return module


def differing(first, second):
    return [name for name, value in first.state_dict().items() if not torch.equal(value, second.state_dict()[name])]


@pytest.mark.parametrize("at", ["first_limits", "poses", "confidence"])
def test_a_run_that_is_cut_off_in_a_lesson_goes_on_with_it(root, tmp_path, taught, monkeypatch, at):
    whole = fit(root, tmp_path / "whole")
    assert taught == list(LESSONS) and whole.confidence.learnt
    taught[:] = [at]
    with pytest.raises(CutOffError):
        fit(root, tmp_path / "first")
    done = taught[1:]
    assert done == list(LESSONS[: LESSONS.index(at)])
    taught.clear()
    with monkeypatch.context() as no_step:
        no_step.setattr(type(whole), "training_step", lambda *_: pytest.fail("no step is left"))
        second = fit(root, tmp_path / "second", checkpoint=tmp_path / "first" / "last.ckpt")
    assert [*done, *taught] == list(LESSONS) and not differing(whole, second)
    kept = torch.load(tmp_path / "second" / "last.ckpt", weights_only=True)
    assert kept["global_step"] == STEPS and torch.equal(
        kept["state_dict"]["confidence.weights"], whole.confidence.weights
    )
    assert sorted(file.name for file in (tmp_path / "second").iterdir()) == ["last.ckpt"]


def test_what_has_ended_stays_and_what_goes_on_training_learns_all_anew(root, tmp_path, taught):
    fit(root, tmp_path / "first")
    assert sorted(file.name for file in (tmp_path / "first").iterdir()) == ["last.ckpt", "step=4.ckpt"]
    taught.clear()
    fit(root, tmp_path / "second", checkpoint=tmp_path / "first" / "last.ckpt")
    assert not taught
    fit(root, tmp_path / "third", STEPS + 2, checkpoint=tmp_path / "first" / "last.ckpt")
    assert taught == list(LESSONS)


def test_a_checkpoint_of_before_there_were_notes_has_learnt_all(root, tmp_path, taught):
    fit(root, tmp_path / "first")
    content = torch.load(tmp_path / "first" / "last.ckpt", weights_only=True)
    content["callbacks"] = {"LearnConfidence": {}}
    torch.save(content, tmp_path / "older.ckpt")
    taught.clear()
    fit(root, tmp_path / "second", checkpoint=tmp_path / "older.ckpt")
    assert not taught


def test_where_nothing_calibrates_nothing_is_taught(root, tmp_path, taught):
    fit(root, tmp_path / "first", calibration_samples=0)
    assert not taught
