"""`articulate-ssl predict CLOUD --category laptop`: from a scan to a folder of results, by the weights of the package.

A thin client of the Python interface (`articulate_ssl.load`): what it prints and writes, a program can have.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import track
from rich.table import Table

from articulate_ssl.cli import BAD_INPUT
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.export.formats import (
    FORMATS,
    MODELS,
    ON_REQUEST,
    ExportError,
    chosen_formats,
    demand_folder,
)
from articulate_ssl.ops.progress import shown
from articulate_ssl.training.shipped_weights import shipped_weights
from articulate_ssl.training.weights_card import VIEWS, WeightsCard

if TYPE_CHECKING:
    import numpy as np
    import torch

    from articulate_ssl.inference.scan_prediction import ScanPrediction
    from articulate_ssl.pretrained.estimator import ArticulatedPoseEstimator

AUTO = "auto"
OFTEN_WRONG = 0.05  # share of the test clouds beyond which weights are warned of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("cloud", type=Path, help="scan of one object: .ply, .pcd, .npy, .npz or .obj, in any unit")
    weights = parser.add_mutually_exclusive_group(required=True)
    categories = dict.fromkeys(weights.category for weights in shipped_weights())
    weights.add_argument(
        "--category",
        choices=[*categories, AUTO],
        help="use the weights of the package for this category; auto: of the category that explains the scan best",
    )
    weights.add_argument(
        "--ckpt",
        help="use these weights: a checkpoint of `lightning fit`, a .safetensors file, a folder of `save_pretrained`, "
        "or a repository on the Hugging Face hub",
    )
    parser.add_argument(
        "--view",
        choices=[*VIEWS, AUTO],
        default=AUTO,
        help="how the scan was taken, with --category: "
        + "; ".join(f"{view}: {what}" for view, what in VIEWS.items())
        + "; auto (default): whichever weights explain the scan better",
    )
    parser.add_argument(
        "--on-table",
        action="store_true",
        help="the scan also shows what the object stands on: find that surface, and take the largest thing on it",
    )
    parser.add_argument("--out", type=Path, help="folder for the results (default: <name of the scan>-prediction)")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda, cuda:1, …")
    parser.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="sharpen the prediction by a few optimisation steps on the reconstruction (default: yes)",
    )
    parser.add_argument(
        "--formats",
        type=_formats,
        help=f"what to write, with commas between: {', '.join(FORMATS)} (default: all that can be written "
        f"but {', '.join(ON_REQUEST)}, which takes seconds)",
    )
    parser.add_argument("--html", action="store_true", help="also write a page to look at and move it in a browser")
    parser.add_argument(
        "--check", action="store_true", help="let MuJoCo drop it and move its joints, and say how it went"
    )
    parser.add_argument(
        "--metres-per-unit",
        type=_length,
        help="for --check: size of the scan's unit, .001 for millimetres (default: the object is taken to be half a "
        "metre large)",
    )


def run(arguments: list[str]) -> int:
    """Predict, write the results, print a summary.

    Returns:
        Exit code: 0, or 2 for a bad scan, checkpoint or output folder, with one message on stderr.

    Raises:
        SystemExit: of code 2 for bad arguments, with the usage on stderr; of code 0 for --help.
    """
    parser = argparse.ArgumentParser(
        prog="articulate-ssl predict", description="Parts, poses and joints of the object in one scan."
    )
    add_arguments(parser)
    args = parser.parse_args(arguments[1:])
    if args.ckpt and args.view != AUTO:
        parser.error("--view chooses among the weights of the package: give it with --category, or leave it out")
    if args.metres_per_unit is not None and not args.check:
        parser.error("--metres-per-unit is for --check: give both, or leave it out")
    if args.check and args.formats is not None and not set(MODELS) & set(args.formats):
        parser.error(f"--check reads {' or '.join(MODELS)}: name one in --formats, or leave --formats out")
    out = args.out or Path(f"{args.cloud.stem}-prediction")
    from datamodules.point_cloud_io import PointCloudError

    try:
        demand_folder(out)
        # First: what is wrong with it is said before networks are imported, which takes seconds.
        cloud = _scan(args)
        candidates, chosen = _predict(args, cloud, _device(args, parser))
        files = _write(candidates[0], out, args)
        _print_summary(candidates, files, chosen)
        if args.check:
            _print_check(out, files, args.metres_per_unit)
    except (PointCloudError, CheckpointError, ExportError, OSError) as error:
        print(f"articulate-ssl predict: {error}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _scan(args: argparse.Namespace) -> np.ndarray:  # [N, 3]
    from datamodules.point_cloud_io import load_point_cloud
    from datamodules.standing_object import load_standing_object

    return load_standing_object(args.cloud) if args.on_table else load_point_cloud(args.cloud)


def _device(args: argparse.Namespace, parser: argparse.ArgumentParser) -> torch.device:
    from articulate_ssl.inference.device import DeviceError, usable_device

    try:
        return usable_device(args.device)
    except DeviceError as error:
        parser.error(f"--device {error}")


def _predict(
    args: argparse.Namespace, cloud: np.ndarray, device: torch.device
) -> tuple[list[ScanPrediction], ArticulatedPoseEstimator]:
    """What every set of weights that is asked says, best first, and the best one's estimator."""
    from articulate_ssl.ops.denormals import flush_denormals
    from articulate_ssl.pretrained.estimator import load
    from articulate_ssl.pretrained.ranking import ranked

    with flush_denormals():
        estimator = load(args.category or args.ckpt, None if args.view == AUTO else args.view, device)
        several = len(estimator.estimators) > 1
        progress = track(
            estimator.estimators, "trying weights", console=Console(stderr=True), disable=not several, transient=True
        )
        candidates = ranked([one.predict(cloud, args.refine) for one in progress])
    return candidates, next(one for one in estimator.estimators if one.weights == candidates[0].checkpoint)


def _write(result: ScanPrediction, out: Path, args: argparse.Namespace) -> list[Path]:
    with shown():
        files = result.export(out, args.formats)
    if args.html:
        from articulate_ssl.inference.viewer import html_page

        files += html_page.write(result, out)
    return files


def _print_check(out: Path, files: list[Path], metres_per_unit: float | None) -> None:
    from articulate_ssl.inference.export import physics_check

    # The folder may hold the model of an earlier prediction, in another format.
    print(*physics_check.check(out, metres_per_unit, [file.name for file in files]).lines(), sep="\n")


def _print_summary(candidates: list[ScanPrediction], files: list[Path], chosen: ArticulatedPoseEstimator) -> None:
    best = candidates[0]
    summary = best.to_dict()
    console = Console()
    if len(candidates) > 1:
        _print_choice(candidates, console)
    for table in (_parts_table(summary), _joints_table(summary)):
        console.print(table)
    if chosen.module.orientation.limited:
        print("trained on views of an upright camera: the scan is taken to have its axes (x right, y down, z forward)")
    if best.probability is not None:
        print(f"probability that orientation and parts are right: {best.probability:.0%}")
    if best.warning:
        console.print(f"[bold red]warning:[/] this scan is {best.warning}")
    elif best.unlike is not None and len(candidates) == 1:
        print(f"{best.unlike:.0%} of the training clouds are explained better than this scan")
    if chosen.card is not None:
        _print_weakness(chosen.card, console)
    print(f"reconstruction error {summary['reconstruction_error']:.4g} (in the unit of the scan)")
    print("wrote", *files, sep="\n  ")


def _print_weakness(card: WeightsCard, console: Console) -> None:
    """That weights are bad at their category is said with every prediction, not in their card only."""
    wrong = card.metrics.get("above_30_rate", {}).get("mean")  # no card has to know it
    if wrong is not None and wrong > OFTEN_WRONG:
        console.print(
            f"[bold red]warning:[/] these weights turn a part by more than 30 degrees in {wrong:.0%} of their test "
            f"clouds: articulate-ssl weights show {card.category}-{card.view}"
        )


def _print_choice(candidates: list[ScanPrediction], console: Console) -> None:
    """Which weights were tried, what each makes of the scan, and how sure the choice of a category is."""
    from articulate_ssl.pretrained.ranking import how_sure

    table = Table("category", "view", title="weights that were tried, best first")
    for column in ("training clouds explained better", "probability", "error / size"):
        table.add_column(column, justify="right")
    for candidate in candidates:
        category, _, view = candidate.checkpoint.rpartition("-")
        shares = ("-" if share is None else f"{share:.0%}" for share in (candidate.unlike, candidate.probability))
        table.add_row(category, view, *shares, f"{candidate.relative_error:.3f}")
    console.print(table)
    if len({candidate.category for candidate in candidates}) > 1:
        print(how_sure(candidates))


def _formats(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    try:
        chosen_formats(names)
    except ExportError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    if not names:
        raise argparse.ArgumentTypeError(f"nothing would be written; name some of {', '.join(FORMATS)}")
    return names


def _length(text: str) -> float:
    try:
        length = float(text)
    except ValueError:
        length = math.nan
    if not 0 < length < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no length; use a positive number, .001 for millimetres")
    return length


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
