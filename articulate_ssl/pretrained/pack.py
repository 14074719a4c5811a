"""From a run that was trained and tested to weights and a card in the package.

What the card says is read from what the run left: the configuration that Lightning saved beside `metrics.json`, the
manifest of the data set, the metrics themselves. The one thing they do not say, which files `-c` named, is checked: the
configuration must be what the command on the card would make.
"""

from __future__ import annotations

import json
import logging
import shlex
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.metrics.report import JSON_NAME, MULTI_STATE
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.lessons import teach
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER, ShippedWeights
from articulate_ssl.training.weights_card import CARD_SUFFIX, HEADLINES, SUFFIX, WeightsCard
from articulate_ssl.training.weights_file import write_weights
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import Manifest, set_folder

VIEW_OF_DATA = {"complete": "complete", "partial": "depth"}
PROFILES = {
    "complete": ("configs/profiles/cpu.yaml",),
    "depth": ("configs/profiles/cpu.yaml", "configs/profiles/depth_camera.yaml"),
}
MULTI_STATE_PROFILE = {
    "complete": "configs/profiles/multi_state.yaml",
    "depth": "configs/profiles/depth_from_scans.yaml",
}
_PLACES = {("data", "root"), ("data", "scans"), ("trainer", "default_root_dir")}  # options that say where, not what
_KEPT_COUNTS = ("samples", "instances", "failures")

# From where on a number of the test is named as a weakness. Chosen, not measured: what a user would notice.
_DOUBTFUL_SHARE = 0.02
_DOUBTFUL_DEGREES = 10.0
_DOUBTFUL_LENGTH = 0.1
_DOUBTFUL_IOU = 0.75
_FEW_INSTANCES = 10

logger = logging.getLogger(__name__)


def pack(
    metrics_json: Path,
    checkpoint: Path | None = None,
    commit: str = "unknown",
    folder: Path = WEIGHTS_FOLDER,
) -> ShippedWeights:
    """Write weights and card of a tested run.

    Args:
        metrics_json: Of `lightning test`; `config.yaml` lies beside it, and the data set is still where that says.
        checkpoint: What was tested; None takes the path that the metrics name.
        commit: Of the code that trained.
        folder: Where to write.

    Raises:
        CheckpointError: if something of the run is missing, its parts do not belong together, or the configuration is
            not that of the command on the card.
    """
    metrics, config = _read_json(metrics_json), _read_yaml(metrics_json.with_name("config.yaml"))
    module = load_module(checkpoint or metrics["checkpoint"])
    data = config["data"]
    manifest = Manifest.load(set_folder(data["root"], data["category"], data["source"], data["view"], _protocol(data)))
    view = VIEW_OF_DATA[manifest.view]
    if not metrics["category"] == module.category == manifest.category:
        raise CheckpointError(f"{metrics_json}: of {metrics['category']}, but the checkpoint is of {module.category}")
    setting = metrics.get("setting")
    command = fit_command(module.category, view, int(config["seed_everything"]), setting == MULTI_STATE)
    _refuse_other_options(metrics_json, config, command)
    _learn_confidence(module, data)
    weights = ShippedWeights(module.category, view, folder / f"{module.category}-{view}{SUFFIX}")
    card = WeightsCard(
        category=module.category,
        view=view,
        part_names=list(manifest.part_names),
        data=_about_data(manifest) | _about_scans(data.get("scans")),
        training={
            "command": shlex.join(command),
            "seed": int(config["seed_everything"]),
            "steps": int(config["trainer"]["max_steps"]),
            "commit": commit,
        },
        metrics={name: metrics[name] for name in (*HEADLINES, *_KEPT_COUNTS)},
        weaknesses=weaknesses(metrics, list(manifest.part_names), view),
        date=date.fromtimestamp(metrics_json.stat().st_mtime).isoformat(),
        setting=setting,
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_weights(module, weights.file)
    card.save(weights.file.with_suffix(CARD_SUFFIX))
    return weights


def newest_metrics(run: Path) -> Path:
    """The newest `metrics.json` under the folder of a run.

    Raises:
        CheckpointError: if there is none.
    """
    found = sorted(run.glob(f"**/{JSON_NAME}"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise CheckpointError(f"{run}: no {JSON_NAME} under it; run `lightning test` first")
    return found[-1]


def fit_command(category: str, view: str, seed: int, multi_state: bool = False) -> list[str]:
    """What trains the weights of a category and view, as a person types it (but for where things lie)."""
    files = (f"configs/{category}.yaml", *PROFILES[view], *((MULTI_STATE_PROFILE[view],) if multi_state else ()))
    scans = ("--data.scans", f"data/{category}/procedural-complete") if multi_state and view == "depth" else ()
    return [
        "lightning",
        "fit",
        *(word for file in files for word in ("-c", file)),
        *scans,
        "--seed_everything",
        str(seed),
    ]


def generate_arguments(manifest: Manifest) -> list[str]:
    """Arguments of `python -m render.generate` that make a set again, but for where."""
    own = ("rotations",) if manifest.view == "complete" else ("protocol", "views")
    names = ("category", "view", "seed", "train_instances", "test_instances", "states", *own)
    options = {name: manifest.options[name] for name in names}
    special = ("variant", "range_deg", "noise_std")
    options |= {name: manifest.options[name] for name in special if manifest.options.get(name)}
    words = []
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, list) else [value])]
    return words


def weaknesses(
    metrics: dict[str, Any],  # of `metrics.json`
    part_names: list[str],
    view: str,
) -> list[str]:
    """What to know before relying on weights, in sentences: the worst numbers, and what was not measured."""
    found = []
    for name, angle in (("flip_rate", 90), ("above_30_rate", 30)):
        if (share := metrics[name]["mean"]) > _DOUBTFUL_SHARE:
            found.append(f"in {share:.0%} of the test clouds a part is turned by more than {angle} degrees")
    for part, single in zip(part_names, metrics["seg_miou"]["parts"], strict=True):
        if single["mean"] < _DOUBTFUL_IOU:
            found.append(f"points of the {part} are found with an IoU of {single['mean']:.0%} only")
    for j, axis in enumerate(metrics["axis_err_deg"]["joints"]):
        pivot, state = metrics["pivot_err"]["joints"][j]["mean"], metrics["state_err"]["joints"][j]["mean"]
        if axis["mean"] > _DOUBTFUL_DEGREES:
            found.append(f"the axis of joint {j} is off by {axis['mean']:.0f} degrees in the mean")
        if pivot is None and state > _DOUBTFUL_LENGTH:  # it slides
            found.append(f"the state of joint {j} is off by {state:.2f} of the object's size in the mean")
        if pivot is not None and state > _DOUBTFUL_DEGREES:
            found.append(f"the state of joint {j} is off by {state:.0f} degrees in the mean")
        if pivot is not None and pivot > _DOUBTFUL_LENGTH:
            found.append(f"the line of joint {j} is off by {pivot:.2f} of the object's size in the mean")
    if metrics["instances"] < _FEW_INSTANCES:
        found.append(
            f"the intervals come from {metrics['instances']} test objects, which is few for a bootstrap: take them for "
            "too narrow"
        )
    found.append("trained and tested on generated objects: how far real ones differ is in none of these numbers")
    found.append("the cloud must show one object and nothing else; strong noise and missing parts were never seen")
    if view == "depth":
        found.append("the camera must be upright and the scan in its frame; the object may be turned by 100 degrees")
    else:
        found.append("the cloud must show the object from all sides: a single view is not what it was trained on")
    return found


def _about_data(manifest: Manifest) -> dict[str, Any]:
    return {
        "command": shlex.join(["python", "-m", "render.generate", *generate_arguments(manifest)]),
        "seed": manifest.seed,
        "train_instances": len(manifest.instances["train"]),
        "test_instances": len(manifest.instances["test"]),
    }


def _about_scans(folder: str | None) -> dict[str, Any]:
    """Of the complete clouds that taught a network for depth views, if some did."""
    return {} if folder is None else {"scans": _about_data(Manifest.load(folder))["command"]}


def _learn_confidence(module: ArticulatedPoseModule, data: dict[str, Any]) -> None:
    """For runs that ended without it, as those of before it was learnt with the last step."""
    if module.confidence.learnt:
        return
    own = {name: data[name] for name in ("category", "root", "source", "view", "num_points")}
    teach(module, SetClouds(ArticulatedDataModule(**own)), ("confidence",))


def _refuse_other_options(
    metrics_json: Path,
    config: dict[str, Any],
    command: list[str],
) -> None:
    files = [Path(word) for flag, word in pairwise(command) if flag == "-c"]
    expected: dict[tuple[str, ...], Any] = {}
    for file in files:
        expected |= _leaves(_read_yaml(file))
    found = _leaves(config)
    other = [
        f"{'.'.join(name)} is {found.get(name)!r}, not {value!r}"
        for name, value in expected.items()
        if name not in _PLACES and found.get(name) != value
    ]
    if other:
        raise CheckpointError(
            f"{metrics_json}: not a run of `{shlex.join(command)}`: {'; '.join(other)}; only such runs can have a card"
        )


def _leaves(options: dict[str, Any], prefix: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    leaves = {}
    for name, value in options.items():
        leaves |= _leaves(value, (*prefix, name)) if isinstance(value, dict) else {(*prefix, name): value}
    return leaves


def _protocol(data: dict[str, Any]) -> str | None:
    return data["protocol"] or ("honest" if data["view"] == "partial" else None)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); name the {JSON_NAME} of `lightning test`") from error


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        return yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); run this in the folder of the project") from error
