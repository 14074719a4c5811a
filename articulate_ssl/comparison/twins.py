"""`make twins CAT=laptop`: the parts and joints of single objects from scans of each, measured on labelled objects.

Every object of a set's test split is found from its own clouds alone (`inference.twin`), turned at random, as a user
would scan it; labels score, and are read afterwards. No network and no training. What is measured is kept object by
object, so it may be interrupted, and objects that were measured by the same code are not found again.

    make data CAT=laptop ARGS="--train-instances 0 --test-instances 10 --states 12 --rotations 1"
    make twins CAT=laptop
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS
from articulate_ssl.discovery.references import evenly_chosen
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.inference.twin import Twin, find_twin
from articulate_ssl.metrics.articulated_pose import cloud_errors
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.ops.progress import shown
from articulate_ssl.pretrained.rebuild import commit_of
from datamodules.articulated_dataset import ArticulatedDataset
from datamodules.atomic import atomic_write
from datamodules.manifest import Manifest, ManifestError, set_folder
from datamodules.shards import ShardError

CLOUDS = 12  # of each object
# Means over an object's clouds, and over its parts or joints; angles in degrees, lengths in units of its size.
ERRORS = ("seg_miou", "r_err_deg", "axis_err_deg", "pivot_err", "state_err")
_BAD_INPUT = 2


@dataclass(frozen=True)
class Measured:
    """One object.

    Attributes:
        name: Its id.
        errors: By name, None where it does not exist, as the pivot of what slides; None if its parts were not found.
        unexplained: Share of its points off whichever part they are moved with, which a user is told, too.
        seconds: CPU time.
    """

    name: str
    errors: dict[str, float | None] | None
    unexplained: float | None
    seconds: float


def measure(
    labels: dict[str, Tensor],  # of `ArticulatedDataset` with `dense`, all of one object
    name: str,
    seed: int,
) -> Measured:
    """Find an object in its clouds, and compare it with their labels.

    Which of the found parts is which labelled one, and how frames are turned against each other, is constant over its
    clouds, and measured on them (`metrics.calibration`).
    """
    joint = "revolute" if int(labels["joint_type"][0, 0]) == REVOLUTE else "prismatic"
    start = time.process_time()
    try:
        twin = find_twin(list(labels["dense_points"].numpy()), labels["part_pose"].shape[1], joint, seed)
    except DiscoveryError:
        return Measured(name, None, None, time.process_time() - start)
    seconds = time.process_time() - start
    return Measured(name, _errors(twin, labels), twin.unexplained, seconds)


def _errors(twin: Twin, labels: dict[str, Tensor]) -> dict[str, float | None]:
    """`ERRORS` of an object."""
    part_id = torch.from_numpy(np.stack([scan.part_id for scan in twin.scans]))
    prediction = replace(concatenate([scan.prediction for scan in twin.scans]), dense_part_id=part_id)
    labels = labels | {"points": labels["dense_points"][:, : prediction.part_id.shape[1]]}
    errors = cloud_errors(prediction, labels, calibrate(prediction, labels))
    means = {name: float(errors[name].nanmean()) for name in ERRORS}
    return {name: None if mean != mean else mean for name, mean in means.items()}


def measure_set(
    folder: Path,  # of the set
    out: Path,
    clouds: int = CLOUDS,
    seed: int = 0,
    objects: Sequence[str] = (),
) -> list[Measured]:
    """Objects of the test split, those that were measured before by the same code as they were kept.

    Args:
        out: Where they are kept.
        clouds: Of each object.
        seed: Of everything random.
        objects: Ids; all by default.

    Raises:
        ValueError: for an object that the test split lacks.
        ManifestError: if the set is missing, damaged, not of complete clouds, without labels, or of fewer than
            `MIN_CLOUDS` clouds of each object.
        ShardError: if its clouds are damaged.
    """
    manifest = Manifest.load(folder)
    if manifest.view != "complete" or not manifest.labelled:
        raise ManifestError(
            f"{folder}: twins are measured on labelled sets of complete clouds; make one with `make data`"
        )
    per_object = manifest.num_samples("test") // max(1, len(manifest.instances["test"]))
    if per_object < MIN_CLOUDS:
        raise ManifestError(
            f"{folder}: {per_object} test clouds of each object, and twins need {MIN_CLOUDS}: make the set with "
            '`make data … ARGS="--train-instances 0 --test-instances 10 --states 12 --rotations 1"`'
        )
    if unknown := sorted(set(objects) - set(manifest.instances["test"])):
        raise ValueError(f"{folder}: its test split has no {', '.join(unknown)}")
    dataset = ArticulatedDataset(folder, "test", 1, rotate=True, dense=True)
    instance = torch.from_numpy(dataset.labels["instance"])
    shards = [entry.sha256 for entry in manifest.shards["test"]]
    effort = {"shards": shards, "clouds": clouds, "seed": seed, "commit": commit_of(Path(__file__).parent)}
    found = []
    for name in objects or manifest.instances["test"]:
        file = out / f"{name}.json"
        kept = _kept(file, effort)
        if kept is None:
            rows = evenly_chosen((instance == manifest.instances["test"].index(name)).nonzero()[:, 0], clouds)
            with shown():
                kept = measure(dataset.__getitems__(rows.tolist()), name, seed)
            file.parent.mkdir(parents=True, exist_ok=True)  # ids may be paths
            with atomic_write(file) as stream:
                stream.write((json.dumps({"effort": effort, **vars(kept)}, indent=1) + "\n").encode())
        found.append(kept)
    return found


def _kept(file: Path, effort: dict[str, Any]) -> Measured | None:
    """What was measured before, by the same code on the same set.

    Raises:
        ValueError: if the file holds something else.
    """
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text())
        return Measured(**content) if content.pop("effort") == effort else None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: nothing that twins were measured as ({error!r}); delete it") from None


def as_table(objects: Sequence[Measured], title: str) -> Table:
    """One line for each object, then the mean and the worst over those whose parts were found."""
    columns = ("mIoU %", "R °", "axis °", "pivot", "state", "unexplained %", "CPU s")
    table = Table("object", *columns, title=title)
    for one in sorted(objects, key=lambda one: one.name):
        if one.errors is None:
            table.add_row(one.name, "not found", *[""] * (len(columns) - 2), f"{one.seconds:.0f}")
        else:
            table.add_row(one.name, *_cells(one))
    if known := [one for one in objects if one.errors is not None]:
        table.add_section()
        table.add_row("mean", *_cells(_over(known, statistics.fmean, statistics.fmean)))
        table.add_row("worst", *_cells(_over(known, max, min)))
    return table


def _over(objects: Sequence[Measured], of_errors, of_iou) -> Measured:
    """A statistic over objects."""
    errors = {}
    for name in ERRORS:
        values = [one.errors[name] for one in objects if one.errors[name] is not None]
        errors[name] = (of_iou if name == "seg_miou" else of_errors)(values) if values else None
    return Measured("", errors, of_errors(o.unexplained for o in objects), of_errors(o.seconds for o in objects))


def _cells(one: Measured) -> list[str]:
    formats = ("{:.1f}", "{:.1f}", "{:.1f}", "{:.3f}", "{:.2f}")
    shown_errors = [
        "–" if value is None else form.format(value * (100 if name == "seg_miou" else 1))
        for (name, value), form in zip(one.errors.items(), formats, strict=True)
    ]
    return [*shown_errors, f"{100 * one.unexplained:.1f}", f"{one.seconds:.0f}"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table.

    Returns:
        Exit code: 0, or 2 for bad input.
    """
    parser = argparse.ArgumentParser(
        prog="python -m articulate_ssl.comparison.twins", description=__doc__.split("\n")[0]
    )
    add = parser.add_argument
    add("--category", required=True)
    add("--source", default="procedural", help="of the set's objects; default: procedural")
    add("--root", type=Path, default=Path("data"), help="folder that `make data` wrote to; default: data")
    add("--clouds", type=int, default=CLOUDS, help=f"of each object; default: {CLOUDS}")
    add("--objects", nargs="+", default=[], metavar="ID", help="of the set's test split; default: all")
    add("--seed", type=int, default=0, help="of everything random")
    add("--out", type=Path, default=Path("build/twins"), help="of what is measured; default: build/twins")
    args = parser.parse_args(arguments)
    folder = set_folder(str(args.root), args.category, args.source, "complete", None)
    out = args.out / f"{args.category}-{args.source}"
    try:
        objects = measure_set(folder, out, args.clouds, args.seed, args.objects)
    except (ManifestError, ShardError, ValueError, OSError) as error:
        print(f"articulate_ssl.comparison.twins: {error}", file=sys.stderr)
        return _BAD_INPUT
    Console().print(as_table(objects, f"{args.category}, {args.source}: {args.clouds} scans of each object"))
    print(f"kept: {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
