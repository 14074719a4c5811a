"""Training and testing of any method: resumable, and scored as `lightning test` scores the network.

A folder holds one method of one seed: `last.ckpt` while it trains, then `weights.pt` and the note `trained.json`, and
`metrics.json` with `metrics.csv` once it is tested.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from articulate_ssl.baselines.method import (
    DENSE_CLOUDS,
    JOINTS,
    OCCUPANCY,
    PART_LABELS,
    PART_POSES,
    TEST_PARTS,
    Method,
    Problem,
)
from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.metrics.articulated_pose import ArticulatedPoseMetrics
from articulate_ssl.metrics.calibration import Calibration, calibrate
from articulate_ssl.metrics.report import write_report
from articulate_ssl.ops.progress import Stage, announce, announced
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import INPUTS
from datamodules.atomic import atomic_write
from datamodules.manifest import MANIFEST_NAME
from datamodules.shards import UNLABELLED_ARRAYS

CHECKPOINT_NAME, WEIGHTS_NAME, NOTE_NAME = "last.ckpt", "weights.pt", "trained.json"
SAVE_EVERY = 100  # steps; chosen: at most a minute is lost, and saving takes far less
CPU = "CPU"  # as the device of a note
TEST_SEED = 0  # of what predictions draw, e.g. in RANSAC

# What each word of `Method.given` lets training see of a batch, beyond clouds.
SHOWN = {
    PART_LABELS: ("dense_part_id",),
    PART_POSES: ("part_pose", "part_center", "object_rotation"),
    JOINTS: ("joint_axis", "joint_pivot", "joint_state", "joint_parent", "joint_child", "joint_type"),
    OCCUPANCY: ("occupancy_points", "occupancy"),
    TEST_PARTS: (),
    DENSE_CLOUDS: (),
}

log = logging.getLogger(__name__)


def problem_of(data: ArticulatedDataModule, orientation_range: float = 180.0) -> Problem:
    """What any method may know of a set.

    Raises:
        ManifestError: if there is no such set.
        ValueError: if its joints are of several types, or it has no labels to score with.
    """
    manifest = data.manifest
    if not manifest.labelled:
        raise ValueError(f"{data.folder}: has no labels to compare methods with; make a set with `make data`")
    types = set(manifest.joint_types)
    if len(types) != 1:
        raise ValueError(f"{data.folder}: joints of {len(types)} types; methods are told one type for all joints")
    width = max(high - low for low, high in manifest.articulation_range)
    return Problem(manifest.num_parts, types.pop(), width, data.hparams.num_points, orientation_range)


def seen_in_training(batch: dict[str, Tensor], given: tuple[str, ...]) -> dict[str, Tensor]:
    """What of a training batch a method is given; anything else would be a label that its row does not tell of."""
    shown = {*INPUTS, *UNLABELLED_ARRAYS, *(name for word in given for name in SHOWN[word])}
    return {name: value for name, value in batch.items() if name in shown}


def seen_in_test(batch: dict[str, Tensor], given: tuple[str, ...]) -> dict[str, Tensor]:
    """What of a test batch a method is given: the scored points, and with `TEST_PARTS` parts of all that are stored."""
    shown = {"points"}
    if DENSE_CLOUDS in given:
        shown |= {"dense_points"}
    if TEST_PARTS in given:
        shown |= {"dense_points", "dense_part_id"}
    return {name: value for name, value in batch.items() if name in shown}


def train(method: Method, data: ArticulatedDataModule, folder: Path, seed: int) -> dict[str, Any]:
    """Train a method, or go on where the same training was cut off, or load what it left.

    Args:
        method: As `seeded` made it; trained afterwards.
        data: Training clouds, with the dense arrays (`dense_in_fit`).
        folder: Made if missing. What another training (other options, other data) left there is overwritten.
        seed: Of everything that is drawn.

    Returns:
        The note: `what` was trained, the `seconds` that it took, over all attempts, and on which `device` it ended.
    """
    folder.mkdir(parents=True, exist_ok=True)
    what = _described(method, data, seed)
    note, started = folder / NOTE_NAME, folder / "started.json"
    if (finished := _read(note)).get("what") == what:
        _restore(method, torch.load(folder / WEIGHTS_NAME, map_location="cpu", weights_only=True))
        return finished
    note.unlink(missing_ok=True)
    last = folder / CHECKPOINT_NAME
    if _read(started).get("what") != what:
        last.unlink(missing_ok=True)
        _write(started, {"what": what})
    keep = _Keep(last)
    if last.is_file():
        _restore(method, torch.load(last, map_location="cpu", weights_only=True)["state_dict"])
    else:
        torch.manual_seed(seed)
        begun = time.perf_counter()
        data.setup("fit")
        method.prepare(data, seed)
        keep.seconds = time.perf_counter() - begun
    if method.effort.steps:
        _fit(method, data, last, keep)
    with atomic_write(folder / WEIGHTS_NAME) as file:
        torch.save(method.state_dict(), file)
    finished = {"what": what, "seconds": keep.seconds, "device": _device_name()}
    _write(note, finished)
    for file in (last, started):
        file.unlink(missing_ok=True)
    return finished


def test(method: Method, data: ArticulatedDataModule, folder: Path, trained: dict[str, Any]) -> dict[str, Any]:
    """Score a trained method on the test clouds and write `metrics.json`, `metrics.csv` and `objects.csv`.

    Args:
        method: Trained.
        data: Whose test clouds.
        folder: Of what is written.
        trained: What `train` returned.

    Returns:
        The content of `metrics.json`.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    method.to(device).eval()
    data.setup("test")
    torch.manual_seed(TEST_SEED)
    calibration = _calibration(method, data)
    metrics, seconds = ArticulatedPoseMetrics(calibration), 0.0
    for batch in announced(log, f"{method.title}: test", data.test_dataloader()):
        prediction, taken = _predict(method, batch)
        metrics.update(prediction, batch)
        seconds += taken
    result = metrics.compute()
    manifest = data.manifest
    return write_report(
        folder,
        result,
        category=manifest.category,
        source=manifest.source,
        protocol=manifest.protocol or manifest.view,
        checkpoint=str(folder / WEIGHTS_NAME),
        seconds_per_cloud=seconds / result["samples"],
        per_object=(metrics.per_object(), manifest.instances["test"]),
        method=method.title,
        given=list(method.given),
        says=list(method.says),
        parameters=_size(method),
        train_seconds=trained["seconds"],
        trained_on=trained.get("device"),  # older notes have none
        part_names=list(manifest.part_names),
        calibration=calibration.to_dict(),
    )


def seeded(method: type[Method], problem: Problem, seed: int, steps: int | None = None) -> Method:
    """A new method whose first weights depend on the seed alone; `steps`, for one that learns, replace its own."""
    torch.manual_seed(seed)
    made = method(problem)
    if steps is not None and made.effort.steps:
        made.effort = replace(made.effort, steps=steps)
    return made


def _described(method: Method, data: ArticulatedDataModule, seed: int) -> dict[str, Any]:
    """All that the outcome of a training depends on but the code, as JSON gives it back; of the code, its size."""
    problem, effort = asdict(method.problem), asdict(method.effort)
    clouds = hashlib.sha256((data.folder / MANIFEST_NAME).read_bytes()).hexdigest()
    what = {"method": method.title, "parameters": _size(method), "problem": problem, "effort": effort}
    return what | {"seed": seed, "data": clouds}


def _device_name() -> str:
    return torch.cuda.get_device_name() if torch.cuda.is_available() else CPU


def _size(method: Method) -> int:
    return sum(parameter.numel() for parameter in method.parameters())


def _fit(method: Method, data: ArticulatedDataModule, last: Path, keep: _Keep) -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning's, about itself and about loaders without workers
        trainer = Trainer(
            accelerator="auto",
            devices=1,
            max_steps=method.effort.steps,
            limit_val_batches=0,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=[keep],
            default_root_dir=last.parent,
        )
        trainer.fit(method, data, ckpt_path=last if last.is_file() else None, weights_only=True)


class _Keep(Callback):
    """Hides labels that are not given, announces steps, counts seconds, and saves all that it takes to go on.

    Args:
        last: The checkpoint.
    """

    def __init__(self, last: Path) -> None:
        self.last, self.seconds, self._random = last, 0.0, None

    def state_dict(self) -> dict[str, Any]:
        """Lightning saves this in every checkpoint."""
        return {"seconds": self.seconds, "random": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting, and drawing, where the checkpoint was made."""
        self.seconds, self._random = state_dict["seconds"], state_dict["random"]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Time runs."""
        self._since = time.perf_counter()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: Method, batch: dict[str, Tensor], batch_idx: int
    ) -> None:
        """Announce; keep labels from the method; after an interruption, draw what would have been drawn."""
        announce(log, Stage(f"{pl_module.title}: training", "", trainer.global_step, trainer.max_steps))
        for name in set(batch) - set(seen_in_training(batch, pl_module.given)):
            del batch[name]
        if self._random is not None:
            torch.set_rng_state(self._random)
            self._random = None

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Count, and save now and then."""
        now = time.perf_counter()
        self.seconds, self._since = self.seconds + now - self._since, now
        if trainer.global_step % SAVE_EVERY == 0:
            trainer.save_checkpoint(self.last)

    def on_train_end(self, trainer: Trainer, pl_module: Method) -> None:
        """Announce the end."""
        announce(log, Stage(f"{pl_module.title}: training", "", trainer.max_steps, trainer.max_steps))


def _restore(method: Method, state: dict[str, Tensor]) -> None:
    """Load weights, and buffers of the sizes that `prepare` gave them."""
    for name, value in state.items():
        path, _, leaf = name.rpartition(".")
        owner = method.get_submodule(path)
        if leaf in owner._buffers:
            setattr(owner, leaf, value.clone())
    method.load_state_dict(state)


def _calibration(method: Method, data: ArticulatedDataModule) -> Calibration:
    """On training clouds: of the labels, where the method speaks of the labelled spaces, else of its predictions."""
    batches = list(data.calibration_dataloader())
    labels = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
    if method.labelled_spaces:
        return calibrate(perfect_oracle(labels), labels)
    shown = announced(log, f"{method.title}: calibration on training clouds", batches)
    return calibrate(concatenate([_predict(method, batch)[0] for batch in shown]), labels)


@torch.no_grad()
def _predict(method: Method, batch: dict[str, Tensor]) -> tuple[Prediction, float]:
    """What a method says about clouds, on the CPU, and the seconds that it took."""
    seen = {name: value.to(method.device) for name, value in seen_in_test(batch, method.given).items()}
    begun = time.perf_counter()
    prediction = method.predict(seen).to("cpu")
    return prediction, time.perf_counter() - begun


def _read(note: Path) -> dict[str, Any]:
    return json.loads(note.read_text()) if note.is_file() else {}


def _write(note: Path, content: dict[str, Any]) -> None:
    with atomic_write(note) as file:
        file.write(json.dumps(content).encode())
