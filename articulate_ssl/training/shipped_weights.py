"""The weights that come with the package, and how weights are named.

They are package data of `articulate_ssl.pretrained`, `<category>-<view>.safetensors` with a card beside each; what
makes them lies there too. A name is looked up here first and nowhere else if it is one of theirs: a shipped name never
touches the network.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.training.weights_card import SUFFIX, VIEWS

WEIGHTS_FOLDER = Path(__file__).parent.parent / "pretrained" / "weights"
MODEL_FILE = f"model{SUFFIX}"  # in a folder of its own, or on the hub
_FILES = (SUFFIX, ".ckpt")


class ShippedWeights(NamedTuple):
    """Weights that come with the package."""

    category: str
    view: str
    file: Path

    @property
    def name(self) -> str:
        """As `from_pretrained` and `load` take it."""
        return f"{self.category}-{self.view}"


def shipped_weights() -> tuple[ShippedWeights, ...]:
    """All of them, by category, then as `VIEWS` are listed: the first one asks nothing of the user's frame."""
    parts = [(*file.stem.rpartition("-"), file) for file in WEIGHTS_FOLDER.glob(f"*{SUFFIX}")]
    found = [ShippedWeights(category, view, file) for category, _, view, file in parts if view in VIEWS]
    return tuple(sorted(found, key=lambda weights: (weights.category, list(VIEWS).index(weights.view))))


def shipped_as(
    name: str,  # a category, or <category>-<view>
    view: str | None = None,
) -> tuple[ShippedWeights, ...]:
    """The shipped weights that a name stands for: none for a name that is not shipped, else one for each view.

    Raises:
        CheckpointError: if the category is shipped, but not in this view.
    """
    found = [weights for weights in shipped_weights() if name in (weights.category, weights.name)]
    chosen = tuple(weights for weights in found if view in (None, weights.view))
    if found and not chosen:
        raise CheckpointError(
            f"{name}: no weights for view {view!r} come with the package, only {', '.join(w.view for w in found)}"
        )
    return chosen


def find_weights(
    name_or_path: str | os.PathLike,
    view: str | None = None,
    revision: str | None = None,
    token: str | bool | None = None,
    cache_dir: str | os.PathLike | None = None,
    local_files_only: bool = False,
    force_download: bool = False,
) -> Path:
    """The file of weights that is meant: a shipped name, a file, a folder that `save_pretrained` wrote, or a hub id.

    Only a hub id (`owner/name`) that is none of the others touches the network; the options behind `view` are for it.

    Raises:
        CheckpointError: if nothing of this name is here or on the hub, the hub cannot be reached, or a view is chosen
            of weights that do not come with the package.
    """
    if shipped := shipped_as(str(name_or_path), view):
        return shipped[0].file
    if view is not None:
        raise CheckpointError(
            f"{name_or_path}: view={view!r} chooses among weights of one category that come with the package, which "
            "this is not; leave it out"
        )
    path = Path(name_or_path)
    if path.is_dir():
        if not (path / MODEL_FILE).is_file():
            raise CheckpointError(f"{path}: this folder holds no {MODEL_FILE}; name a folder of `save_pretrained`")
        return path / MODEL_FILE
    if path.is_file() or path.suffix in _FILES:
        return path  # who reads it says what is wrong with it
    if path.is_absolute() or len(path.parts) != 2:
        raise CheckpointError(f"{name_or_path}: neither a file nor weights of the package; those are {_shipped_list()}")
    # Imported here: who asks for weights of the package needs none of it.
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, HFValidationError

    hub = {"revision": revision, "token": token, "cache_dir": cache_dir}
    hub |= {"local_files_only": local_files_only, "force_download": force_download}
    try:
        return Path(hf_hub_download(str(name_or_path), MODEL_FILE, **hub))
    except (OSError, EntryNotFoundError, HFValidationError) as error:
        raise CheckpointError(
            f"{name_or_path}: not here, and not to be had from the Hugging Face hub "
            f"({str(error).splitlines()[0]}); check the name and the network, or use weights of the package: "
            f"{_shipped_list()}"
        ) from error


def _shipped_list() -> str:
    return ", ".join(weights.name for weights in shipped_weights()) or "none (`make weights` makes them)"
