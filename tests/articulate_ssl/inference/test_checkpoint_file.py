import pickle

import lightning
import pytest
import torch

from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, CheckpointError, read_checkpoint


class TinyModule(lightning.LightningModule):
    def __init__(self, category="laptop", dims=(16, 32)):
        super().__init__()
        self.save_hyperparameters()
        self.layer = torch.nn.Linear(3, 3)

    def on_save_checkpoint(self, checkpoint):
        checkpoint[CHECKPOINT_KEY] = {"category": "laptop"}


@pytest.fixture
def checkpoint(tmp_path):
    trainer = lightning.Trainer(logger=False, accelerator="cpu", barebones=False, enable_checkpointing=False)
    trainer.strategy.connect(TinyModule())
    trainer.save_checkpoint(tmp_path / "good.ckpt", weights_only=False)
    return tmp_path / "good.ckpt"


def test_a_lightning_checkpoint_is_read(checkpoint):
    content = read_checkpoint(checkpoint)
    assert content[CHECKPOINT_KEY] == {"category": "laptop"}
    assert content["hyper_parameters"] == {"category": "laptop", "dims": (16, 32)}
    TinyModule().load_state_dict(content["state_dict"])


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.999])
def test_a_truncated_checkpoint_is_refused(checkpoint, share):
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"good\.ckpt: damaged"):
        read_checkpoint(checkpoint)


@pytest.mark.parametrize("content", [b"hello world", bytes(range(256)) * 20, pickle.dumps({"state_dict": {}})])
def test_a_file_that_is_no_checkpoint_is_refused(tmp_path, content):
    (tmp_path / "x.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        read_checkpoint(tmp_path / "x.ckpt")


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path):
    content = {CHECKPOINT_KEY: Trap(), "state_dict": {}, "hyper_parameters": {}}
    torch.save(content, tmp_path / "evil.ckpt")
    with pytest.raises(CheckpointError, match="pickled objects, which are not read"):
        read_checkpoint(tmp_path / "evil.ckpt")


@pytest.mark.parametrize(
    "content", [{"state_dict": {}, "hyper_parameters": {}}, {"model": torch.ones(2)}, torch.ones(3)]
)
def test_a_checkpoint_of_another_project_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "other.ckpt")
    with pytest.raises(CheckpointError, match=f"another project.*{CHECKPOINT_KEY}"):
        read_checkpoint(tmp_path / "other.ckpt")


def test_a_missing_checkpoint_says_how_to_make_one(tmp_path):
    with pytest.raises(CheckpointError, match=r"no such checkpoint.*lightning fit"):
        read_checkpoint(tmp_path / "none.ckpt")


def test_a_folder_is_refused_with_the_newest_checkpoint_in_it(checkpoint, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"a folder, not a checkpoint.*newest one in it is .*good\.ckpt"):
        read_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match=r"a folder, not a checkpoint; name a \.ckpt file"):
        read_checkpoint(tmp_path / "empty")


@pytest.mark.parametrize("name", ["good", "good.pt", "good.ckpt.zip", "good.safetensors"])
def test_a_file_of_another_suffix_is_refused(checkpoint, name):
    """Lightning chooses its reader by the suffix."""
    other = checkpoint.rename(checkpoint.parent / name)
    with pytest.raises(CheckpointError, match=r"not a \.ckpt file"):
        read_checkpoint(other)


@pytest.mark.parametrize("first", range(0, 256, 5))
def test_bytes_of_any_kind_are_refused(tmp_path, first):
    """torch's reader of old formats fails on such files in ways of its own, IndexError among them."""
    (tmp_path / "x.ckpt").write_bytes(bytes([first, 46, 46, 10]))
    with pytest.raises(CheckpointError, match="damaged"):
        read_checkpoint(tmp_path / "x.ckpt")
