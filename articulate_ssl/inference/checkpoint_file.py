"""Checkpoints from anywhere: told apart and refused before any of their content can act."""

from __future__ import annotations

import os
import pickle
import warnings
from pathlib import Path
from typing import Any

import torch

CHECKPOINT_KEY = "articulate_ssl"


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, foreign or useless; the message names the file and the remedy."""


def read_checkpoint(path: str | os.PathLike) -> dict[str, Any]:
    """The content of a checkpoint that this project's training wrote, on the CPU.

    Only tensors and plain containers are unpickled (`weights_only=True`), so a file that was made to run code is
    refused. Ours carry the entry `CHECKPOINT_KEY` beside `state_dict` and `hyper_parameters`.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what to do.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint; train one with `lightning fit -c configs/<category>.yaml`")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about foreign pickles, whose refusal below says all there is to say
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path}: damaged, or with pickled objects, which are not read because they can run code; "
            "use a .ckpt file that `lightning fit` wrote"
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, AttributeError) as error:
        raise CheckpointError(
            f"{path}: damaged or cut off, cannot be read; copy it again or use another .ckpt file of the same run"
        ) from error
    entries = content.keys() if isinstance(content, dict) else set()
    missing = {CHECKPOINT_KEY, "state_dict", "hyper_parameters"} - entries
    if missing:
        raise CheckpointError(
            f"{path}: a checkpoint of another project (it has no {', '.join(sorted(missing))}); "
            "use a .ckpt file that `lightning fit` wrote"
        )
    return content
