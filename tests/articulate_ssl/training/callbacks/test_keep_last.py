"""A run that is cut off soon after part discovery does not discover again."""

import warnings

import pytest
import torch
from lightning.pytorch import Callback
from lightning.pytorch.callbacks import ModelCheckpoint
from synthetic import write_synthetic_set
from tiny import quiet_trainer, tiny_data, tiny_module

from articulate_ssl.training.callbacks.keep_last import KeepLast
from articulate_ssl.training.recipes import staged


class CutOff(Callback):
    """After two steps of self-supervision."""

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == 3:
            raise KeyError("cut off")


@pytest.mark.parametrize("save_last", [True, False])
def test_discovery_is_kept_where_checkpoints_are(tmp_path, monkeypatch, save_last):
    write_synthetic_set(tmp_path)

    def fit(*more, checkpoint=None):
        module = tiny_module(6, network={"iterations": 1})
        last = ModelCheckpoint(tmp_path, every_n_train_steps=100, save_last=save_last)
        trainer = quiet_trainer(tmp_path, max_steps=6, callbacks=[last, KeepLast(), *more], enable_checkpointing=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trainer.fit(module, tiny_data(tmp_path), ckpt_path=checkpoint)
        return module

    with pytest.raises(KeyError):
        fit(CutOff())
    last = tmp_path / "last.ckpt"
    assert last.exists() == save_last
    if save_last:
        assert torch.load(last, weights_only=True)["global_step"] == 1
        monkeypatch.setattr(staged, "discover", lambda *_: pytest.fail("discovered again"))
        assert fit(checkpoint=last).confidence.learnt
        assert torch.load(last, weights_only=True)["global_step"] == 6
