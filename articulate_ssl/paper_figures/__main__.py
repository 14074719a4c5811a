"""`python -m articulate_ssl.paper_figures --category laptop`: how noise hurts, and what part-level features are."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.ops.progress import shown
from articulate_ssl.paper_figures import noise_curve, part_features
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import shipped_as
from articulate_ssl.training.weights_card import VIEWS
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import ManifestError

_BAD_INPUT = 2
_BATCH = 16
_FEATURE_CLOUDS = 16


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, draw, and print what was written.

    Returns:
        Exit code: 0, or 2 for bad input.
    """
    args = _parser().parse_args(arguments)
    try:
        with shown():
            files = _figures(args)
    except (CheckpointError, ManifestError, ValueError, OSError) as error:
        print(f"articulate_ssl.paper_figures: {error}", file=sys.stderr)
        return _BAD_INPUT
    print("wrote:", *files, sep="\n  ")
    return 0


def _figures(args: argparse.Namespace) -> list[Path]:
    weights = args.weights
    if weights is None:
        shipped = shipped_as(args.category, args.view)
        if not shipped:
            raise CheckpointError(f"no weights of {args.category} come with the package; name a file with --weights")
        weights = shipped[0].file
    module = load_module(weights)
    data = {
        "category": args.category,
        "root": str(args.root),
        "view": "complete" if args.view == "complete" else "partial",
        "num_points": module.num_points,
        "batch_size": _BATCH,
        "max_test_samples": args.samples,
    }
    folder = args.out / f"{args.category}-{args.view}"
    folder.mkdir(parents=True, exist_ok=True)
    of = f"{args.category}, {args.view} clouds"
    with torch.no_grad():
        noise = noise_curve.measure(module, data)
        few = ArticulatedDataModule(**data | {"max_test_samples": _FEATURE_CLOUDS})
        few.setup("test")
        features = part_features.measure(module, next(iter(few.test_dataloader())))
    joint_type = module.articulated.joint_type
    return [
        *noise_curve.write(noise, f"{of}: {noise[True][0]['samples']} test clouds with noise", folder),
        *part_features.write(features, joint_type, f"{of}: do features of one part stay while another moves?", folder),
    ]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m articulate_ssl.paper_figures", description=__doc__)
    parser.add_argument("--category", required=True)
    parser.add_argument("--view", choices=list(VIEWS), default="complete")
    parser.add_argument("--weights", type=Path, help="a checkpoint, or weights (default: those of the package)")
    parser.add_argument("--root", type=Path, default=Path("data"), help="of data sets (default: data)")
    parser.add_argument("--out", type=Path, default=Path("build/figures"), help="default: build/figures")
    parser.add_argument("--samples", type=int, default=200, help="test clouds (default: 200)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
