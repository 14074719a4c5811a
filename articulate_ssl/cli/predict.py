"""`lightning predict CLOUD --ckpt …`: from a scan and a checkpoint to a folder of results."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from articulate_ssl.cli import BAD_INPUT
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.export.folder import write_prediction
from articulate_ssl.inference.point_cloud_io import PointCloudError, load_point_cloud
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import in_scan_frame


class CloudPredictor(Protocol):
    """What this command asks of a trained module.

    Attributes:
        category: What it was trained on.
        state_range: [J, 2] lowest and highest joint state, as `Prediction.joint_state`.
        orientation: How far objects were turned in the clouds that it was trained on.
    """

    category: str
    state_range: Tensor
    orientation: OrientationRange

    def predict_cloud(
        self,
        points: np.ndarray,  # [N, 3] any unit and origin
        refine: bool,
    ) -> tuple[Prediction, np.ndarray, float, np.ndarray]:
        """Prediction (B = 1), center [3] and scale of the normalisation, and the normalised points that it labels."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("cloud", type=Path, help="scan of one object: .ply, .pcd, .npy, .npz or .obj, in any unit")
    parser.add_argument("--ckpt", type=Path, required=True, help="checkpoint that `lightning fit` wrote")
    parser.add_argument("--out", type=Path, help="folder for the results (default: <name of the scan>-prediction)")
    parser.add_argument("--device", type=_device, default="cpu", help="cpu (default), cuda, cuda:1, …")
    parser.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="sharpen the prediction by a few optimisation steps on the reconstruction (default: yes)",
    )


def run(arguments: list[str]) -> int:
    """Predict, write the results, print a summary.

    Returns:
        Exit code: 0, or 2 for a bad scan, checkpoint or output folder, with one message on stderr.

    Raises:
        SystemExit: of code 2 for bad arguments, with the usage on stderr; of code 0 for --help.
    """
    parser = argparse.ArgumentParser(
        prog="lightning predict", description="Parts, poses and joints of the object in one scan."
    )
    add_arguments(parser)
    args = parser.parse_args(arguments[1:])
    out = args.out or Path(f"{args.cloud.stem}-prediction")
    try:
        module, files = _predict(args, out)
    except (PointCloudError, CheckpointError, OSError) as error:
        print(f"articulate-ssl predict: {error}", file=sys.stderr)
        return BAD_INPUT
    _print_summary(out, files, module.orientation)
    return 0


def _predict(args: argparse.Namespace, out: Path) -> tuple[CloudPredictor, list[Path]]:
    """The module that predicted, and the files written."""
    # Imported here: the network takes long to import, and --help needs none of it.
    from articulate_ssl.training.checkpoint import load_module

    cloud = load_point_cloud(args.cloud)
    module: CloudPredictor = load_module(args.ckpt).to(args.device).eval()
    prediction, center, scale, points = module.predict_cloud(cloud, refine=args.refine)
    result = in_scan_frame(
        prediction, points, center, scale, cloud, module.state_range, module.category, str(args.ckpt)
    )
    return module, write_prediction(result, out)


def _print_summary(out: Path, files: list[Path], orientation: OrientationRange) -> None:
    summary = json.loads((out / "prediction.json").read_text())
    for table in (_parts_table(summary), _joints_table(summary)):
        Console().print(table)
    if orientation.limited:
        print("trained on views of an upright camera: the scan is taken to have its axes (x right, y down, z forward)")
    print(f"reconstruction error {summary['reconstruction_error']:.4g} (in the unit of the scan)")
    print("wrote", *files, sep="\n  ")


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise argparse.ArgumentTypeError(f"{name!r} is no device; use cpu, cuda or cuda:<index>") from error
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise argparse.ArgumentTypeError(
            f"{name!r}: this machine has {torch.cuda.device_count()} CUDA devices; use cpu"
        )
    return device


def _parts_table(summary: dict) -> Table:
    table = Table("part", "parent", "points", "size", "position", title=f"{summary['category']}: parts")
    for part in summary["parts"]:
        parent = "base" if part["parent"] is None else str(part["parent"])
        position = [row[3] for row in part["pose"][:3]]
        table.add_row(
            str(part["id"]), parent, str(part["num_points"]), _vector(part["canonical_size"]), _vector(position)
        )
    return table


def _joints_table(summary: dict) -> Table:
    table = Table("joint", "type", "moves", "state", "axis", "pivot", title="joints (frame and unit of the scan)")
    for joint in summary["joints"]:
        state = joint["state"]
        text = f"{math.degrees(state):.1f}°" if joint["type"] == "revolute" else f"{state:.4g}"
        moves = f"{joint['child']} on {joint['parent']}"
        table.add_row(joint["name"], joint["type"], moves, text, _vector(joint["axis"]), _vector(joint["pivot"]))
    return table


def _vector(values: list[float]) -> str:
    return " ".join(f"{value:.3g}" for value in values)
