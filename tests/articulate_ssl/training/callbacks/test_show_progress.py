"""Discovery and calibration are shown, and results do not depend on it."""

import io
import logging
from dataclasses import replace

import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import RichProgressBar
from synthetic import write_synthetic_set
from tiny import DISCOVERY, quiet_trainer, tiny_data, tiny_module

from articulate_ssl.training.callbacks import show_progress
from articulate_ssl.training.callbacks.show_progress import ShowProgress


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_synthetic_set(folder)
    return folder


SMALL = replace(DISCOVERY, starts=2, jointed=1, split_clouds=6, points=32, edge_hinges=False)


def test_discovery_and_calibration_are_told_in_lines_and_change_nothing(root, capsys):
    alone, watched = tiny_module(discovery=SMALL), tiny_module(discovery=SMALL)
    quiet_trainer(root, max_steps=2).fit(alone, tiny_data(root))
    assert "discovery" not in "".join(capsys.readouterr())
    quiet_trainer(root, max_steps=2, callbacks=[ShowProgress()]).fit(watched, tiny_data(root))
    said = capsys.readouterr().err
    assert "part discovery: template 1 of 1, 0 of 4 done" in said and "part discovery: took" in said
    for name, value in alone.state_dict().items():
        assert torch.equal(watched.state_dict()[name], value), name
    trainer = quiet_trainer(root, callbacks=[ShowProgress()])
    trainer.test(watched, tiny_data(root), verbose=False)
    assert "calibration on training clouds, 0 of 2 done" in capsys.readouterr().err


def test_on_a_terminal_discovery_is_a_bar_beside_lightnings(root, monkeypatch):
    monkeypatch.setattr(show_progress, "_TICK", 0.02)
    screen = io.StringIO()
    bar = RichProgressBar(console_kwargs={"file": screen, "force_terminal": True, "width": 160})
    trainer = Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        default_root_dir=root,
        max_steps=2,
        callbacks=[bar, ShowProgress()],
    )
    trainer.fit(tiny_module(discovery=SMALL), tiny_data(root))
    text = screen.getvalue()
    assert "template 1 of 1, descent on" in text and "round 1 of 1" in text
    assert all(not task.description.startswith("part discovery") for task in bar.progress.tasks)


def test_an_exception_ends_the_listening(root):
    module = tiny_module()
    module.recipe.prepare = lambda *_: 1 / 0
    before = list(logging.getLogger("articulate_ssl").handlers)
    with pytest.raises(ZeroDivisionError):
        quiet_trainer(root, max_steps=2, callbacks=[ShowProgress()]).fit(module, tiny_data(root))
    assert logging.getLogger("articulate_ssl").handlers == before
