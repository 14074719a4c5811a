"""Checkpoints from anywhere: told apart and refused before any of their content can act."""

from __future__ import annotations

import os
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any

CHECKPOINT_KEY = "articulate_ssl"
SUFFIX = ".ckpt"


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, foreign or useless; the message names the file and the remedy."""


def read_checkpoint(path: str | os.PathLike) -> dict[str, Any]:
    """The content of a checkpoint that this project's training wrote, on the CPU.

    Only tensors and plain containers are unpickled (`weights_only=True`), so a file that was made to run code is
    refused. Ours carry the entry `CHECKPOINT_KEY` beside `state_dict` and `hyper_parameters`.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what to do.
    """
    import torch  # here, because it takes seconds, and the error alone is needed where no checkpoint is read

    path = Path(path)
    _check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about foreign pickles, whose refusal below says all there is to say
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path}: damaged, or with pickled objects, which are not read because they can run code; "
            "use a .ckpt file that `lightning fit` wrote"
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, LookupError, AttributeError) as error:
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


def _check_file(path: Path) -> None:
    """Refuse what cannot be a checkpoint, whatever it holds."""
    if path.is_dir():
        raise CheckpointError(f"{path}: a folder, not a checkpoint; {_in_folder(path)}")
    if not path.exists():
        raise CheckpointError(f"{path}: no such checkpoint; train one with `lightning fit -c configs/<category>.yaml`")
    if path.suffix != SUFFIX:
        raise CheckpointError(f"{path}: not a {SUFFIX} file; use one that `lightning fit` wrote")
    # What has no table of contents at its end would go to a reader of older formats, which fails in any way it likes.
    if not zipfile.is_zipfile(path):
        raise CheckpointError(
            f"{path}: damaged, cut off, or no checkpoint at all; copy it again or use another .ckpt file of its run"
        )


def _in_folder(folder: Path) -> str:
    found = max(folder.rglob(f"*{SUFFIX}"), key=lambda path: path.stat().st_mtime, default=None)
    return f"the newest one in it is {found}" if found else f"name a {SUFFIX} file that `lightning fit` wrote"
