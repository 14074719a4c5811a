"""From a file of weights to a module that is ready to predict."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.inference.checkpoint_file import CheckpointError, read_checkpoint
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.losses.objective import ObjectiveOptions
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.schedule import ScheduleOptions
from articulate_ssl.training.weights_card import SUFFIX
from articulate_ssl.training.weights_file import read_weights

_GROUPS = {
    "network": NetworkOptions,
    "objective": ObjectiveOptions,
    "schedule": ScheduleOptions,
    "discovery": DiscoveryOptions,
    "inference": InferenceOptions,
}
# Modules of before confidence was learnt have none to load, and say that they have not learnt it.
_OPTIONAL = "confidence."


def load_module(path: str | os.PathLike) -> ArticulatedPoseModule:
    """The trained module of a checkpoint or of a .safetensors file of weights, on the CPU, in evaluation mode.

    Raises:
        CheckpointError: if the file is missing, damaged, foreign, or does not fit this version of the code.
    """
    content = (read_weights if Path(path).suffix == SUFFIX else read_checkpoint)(path)
    try:
        plain = dict(content["hyper_parameters"])
        arguments = {name: _GROUPS[name](**value) if name in _GROUPS else value for name, value in plain.items()}
        module = ArticulatedPoseModule(**arguments)
        _load_state(module, content["state_dict"])
        module.on_load_checkpoint(content)
    except (TypeError, ValueError, RuntimeError, LookupError, AttributeError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path}: does not fit this version of articulate-ssl ({problem}); "
            "train again, or use the version it was made with"
        ) from error
    return module.eval()


def _load_state(module: ArticulatedPoseModule, state: dict[str, Any]) -> None:
    optional = {name: value for name, value in module.state_dict().items() if name.startswith(_OPTIONAL)}
    module.load_state_dict(optional | state)
