"""From a file of weights to a model that predicts, or to a module that trains and tests, too."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, CheckpointError, read_checkpoint
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.losses.objective import ObjectiveOptions
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.model import ArticulatedPoseModel
from articulate_ssl.training.schedule import ScheduleOptions
from articulate_ssl.training.weights_card import SUFFIX
from articulate_ssl.training.weights_file import read_weights

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_Model = TypeVar("_Model", bound=ArticulatedPoseModel)

_GROUPS = {
    "network": NetworkOptions,
    "objective": ObjectiveOptions,
    "schedule": ScheduleOptions,
    "discovery": DiscoveryOptions,
    "inference": InferenceOptions,
}
# Models of before confidence was learnt have none to load, and say that they have not learnt it.
_OPTIONAL = "confidence."


def load_model(path: str | os.PathLike) -> ArticulatedPoseModel:
    """The trained model of a checkpoint or of a .safetensors file of weights, on the CPU, in evaluation mode.

    Raises:
        CheckpointError: if the file is missing, damaged, foreign, or does not fit this version of the code.
    """
    return _load(ArticulatedPoseModel, path)


def load_module(path: str | os.PathLike) -> ArticulatedPoseModule:
    """The same as a LightningModule, which trains and tests; raises what `load_model` does."""
    # Here, because Lightning takes seconds to import, and `load_model` does without.
    from articulate_ssl.training.module import ArticulatedPoseModule

    return _load(ArticulatedPoseModule, path)


def _load(kind: type[_Model], path: str | os.PathLike) -> _Model:
    content = (read_weights if Path(path).suffix == SUFFIX else read_checkpoint)(path)
    try:
        plain = dict(content["hyper_parameters"])
        arguments = {name: _GROUPS[name](**value) if name in _GROUPS else value for name, value in plain.items()}
        model = kind(**arguments)
        _load_state(model, content["state_dict"])
        model.restore(content[CHECKPOINT_KEY])
    except (TypeError, ValueError, RuntimeError, LookupError, AttributeError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path}: does not fit this version of articulate-ssl ({problem}); "
            "train again, or use the version it was made with"
        ) from error
    return model.eval()


def _load_state(model: ArticulatedPoseModel, state: dict[str, Any]) -> None:
    optional = {name: value for name, value in model.state_dict().items() if name.startswith(_OPTIONAL)}
    model.load_state_dict(optional | state)
