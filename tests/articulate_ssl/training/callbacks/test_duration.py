"""The estimates of `lightning fit` come from measurements, and change nothing."""

import re

import pytest
import torch
from synthetic import write_synthetic_set
from tiny import quiet_trainer, tiny_data, tiny_module

from articulate_ssl.discovery.discover import discover
from articulate_ssl.training.callbacks import duration
from articulate_ssl.training.callbacks.duration import EstimateDuration, in_words, step_seconds
from articulate_ssl.training.recipes import staged

STEPS = 26


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_synthetic_set(folder)
    return folder


@pytest.fixture(scope="module")
def memory():
    return {}


@pytest.fixture(autouse=True)
def discovered_once(memory, monkeypatch):
    """Discovery finds the same every time, and takes long."""

    def found(*arguments):
        if not memory:
            memory["found"] = discover(*arguments)
        return memory["found"]

    monkeypatch.setattr(staged, "discover", found)


def trained(root, callbacks, **options):
    module = tiny_module(STEPS, **({"network": {"iterations": 1}} | options))
    torch.manual_seed(1)
    quiet_trainer(root, max_steps=STEPS, callbacks=callbacks).fit(module, tiny_data(root))
    return module, torch.rand(1)


@pytest.mark.parametrize("recipe", ["staged", "paper"])
def test_neither_weights_nor_random_numbers_change(root, recipe):
    alone, number = trained(root, [], recipe=recipe)
    watched, same = trained(root, [EstimateDuration()], recipe=recipe)
    assert torch.equal(number, same)
    for name, value in alone.state_dict().items():
        assert torch.equal(watched.state_dict()[name], value), name
    assert all(parameter.grad is None for parameter in _after_measuring().parameters())


def _after_measuring():
    module = tiny_module()
    assert step_seconds(module, tiny_data("nowhere").hparams) > 0
    return module


def test_there_is_an_estimate_before_and_one_after_some_steps(root, capsys):
    trained(root, [EstimateDuration()])
    first, second = (line for line in capsys.readouterr().out.splitlines() if line.startswith("lightning fit: "))
    assert re.fullmatch(
        r"lightning fit: at most [\d.]+ seconds for 26 steps \(.* s, measured\), after part discovery", first
    )
    assert re.fullmatch(
        r"lightning fit: about [\d.]+ seconds in all: [\d.]+ of part discovery, [\d.]+ for 25 steps; then its .*",
        second,
    )


def test_the_second_estimate_is_what_was_measured(root, capsys, monkeypatch):
    """One second for each of the six steps that cost less, of which one comes with discovery; three for the others."""
    now = [0.0]
    monkeypatch.setattr(duration.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(duration, "step_seconds", lambda *_: 3.0)

    class Passing(EstimateDuration):
        def on_train_batch_end(self, trainer, *rest):
            now[0] += 1.0 if trainer.global_step <= 6 else 3.0
            super().on_train_batch_end(trainer, *rest)

    trained(root, [Passing()], warmup_steps=6)
    first, second = (line for line in capsys.readouterr().out.splitlines() if line.startswith("lightning fit: "))
    assert first.endswith("at most 78 seconds for 26 steps (3 s, measured), after part discovery")
    assert second.endswith("about 66 seconds in all: 1.0 of part discovery, 65 for 25 steps; " + duration._LESSONS)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.4, "0.4 seconds"),
        (57, "57 seconds"),
        (540, "9 minutes"),
        (100, "1.7 minutes"),
        (3 * 3600, "3 hours"),
        (2.5 * 86400, "2.5 days"),
    ],
)
def test_durations_are_told_in_a_fitting_unit(seconds, words):
    assert in_words(seconds) == words
