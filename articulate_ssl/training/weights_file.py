"""Trained weights without what only training needs: one safetensors file, half as large as float32 would be.

Convention of the file:
    Learnt weights of the networks are float16: a weight's relative error is at most 2^-11, which no pose shows (a test
    holds predictions of both to .5 degrees). The category's own parameters (shapes and joint lines, which are
    geometry) and all buffers (running statistics, joint limits, confidence) keep their type. Tables that the
    constructor derives, as kernels and group elements, are not in a state dict and hence not here; neither are the
    optimiser and the clouds that a recipe keeps. The metadata hold one entry, `CHECKPOINT_KEY`: JSON with
    `hyper_parameters` and what else a checkpoint of ours says about the module.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, CheckpointError
from datamodules.atomic import atomic_write

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_GEOMETRY = "articulated.category."  # parameters that are lengths and directions themselves


def write_weights(module: ArticulatedPoseModule, path: str | os.PathLike) -> None:
    """Write a module's weights, whole or not at all; equal modules give equal bytes.

    Raises:
        CheckpointError: if a weight is not finite, or too large for float16.
        OSError: if the file cannot be written.
    """
    learnt = {name for name, _ in module.named_parameters() if not name.startswith(_GEOMETRY)}
    tensors = {
        name: (value.half() if name in learnt else value).detach().cpu().contiguous()
        for name, value in module.state_dict().items()
    }
    broken = [name for name, value in tensors.items() if not value.isfinite().all()]
    if broken:
        raise CheckpointError(f"{path}: {broken[0]} is infinite or NaN in float16; the training diverged, train again")
    kept: dict[str, Any] = {}
    module.on_save_checkpoint(kept)
    about = {name: value for name, value in kept[CHECKPOINT_KEY].items() if name != "recipe"}
    metadata = {"hyper_parameters": dict(module.hparams)} | about
    # One entry only: the order of several is not defined.
    content = save(tensors, {CHECKPOINT_KEY: json.dumps(metadata, sort_keys=True, allow_nan=False)})
    with atomic_write(path) as file:
        file.write(content)


def read_weights(path: str | os.PathLike) -> dict[str, Any]:
    """The content of a file of weights, in the form of `read_checkpoint`; floating point numbers are float32 again.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what to do.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file of weights; check the path")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no dict
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: damaged or cut off, cannot be read; copy it again ({error})") from error
    if CHECKPOINT_KEY not in metadata:
        raise CheckpointError(
            f"{path}: weights of another project (no metadata {CHECKPOINT_KEY}); "
            "use a file that `save_pretrained` or `articulate-ssl weights pack` wrote"
        )
    try:
        about = dict(json.loads(metadata[CHECKPOINT_KEY]))
        hyper_parameters = about.pop("hyper_parameters")
    except (ValueError, TypeError, KeyError) as error:
        raise CheckpointError(
            f"{path}: damaged, its metadata {CHECKPOINT_KEY} are no JSON of ours ({error!r}); copy it again"
        ) from error
    return {
        "state_dict": {k: v.float() if v.dtype == torch.float16 else v for k, v in tensors.items()},
        "hyper_parameters": hyper_parameters,
        CHECKPOINT_KEY: about | {"recipe": None},
    }
