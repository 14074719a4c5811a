"""From a checkpoint file to a module that is ready to predict."""

from __future__ import annotations

import os

from articulate_ssl import options
from articulate_ssl.inference.checkpoint_file import CheckpointError, read_checkpoint
from articulate_ssl.module import ArticulatedPoseModule

_GROUPS = {
    "network": options.NetworkOptions,
    "objective": options.ObjectiveOptions,
    "schedule": options.ScheduleOptions,
    "discovery": options.DiscoveryOptions,
    "inference": options.InferenceOptions,
}


def load_module(path: str | os.PathLike) -> ArticulatedPoseModule:
    """The trained module of a checkpoint, on the CPU, in evaluation mode.

    Raises:
        CheckpointError: if the file is missing, damaged, foreign, or does not fit this version of the code.
    """
    content = read_checkpoint(path)
    plain = dict(content["hyper_parameters"])
    try:
        arguments = {name: _GROUPS[name](**value) if name in _GROUPS else value for name, value in plain.items()}
        module = ArticulatedPoseModule(**arguments)
        module.load_state_dict(content["state_dict"])
    except (TypeError, ValueError, RuntimeError) as error:
        problem = str(error).splitlines()[0]
        raise CheckpointError(
            f"{path}: does not fit this version of articulate-ssl ({problem}); "
            "train again, or use the version it was made with"
        ) from error
    module.on_load_checkpoint(content)
    return module.eval()
