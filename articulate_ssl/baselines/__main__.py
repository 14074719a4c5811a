"""`python -m articulate_ssl.baselines NAME --category laptop`: train and test one method of the comparison."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from articulate_ssl.baselines import METHODS, method_class
from articulate_ssl.baselines.method import OCCUPANCY, Method
from articulate_ssl.baselines.runner import problem_of, seeded, test, train
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.progress import shown
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import PROTOCOLS, VIEWS


@flush_denormals()
def main(arguments: Sequence[str] | None = None) -> int:
    """Train, unless that is done, and test.

    Returns:
        Exit code: 0, or 2 for a bad option or data set, with one message on stderr.
    """
    args = _parser().parse_args(arguments)
    try:
        _run(args)
    except ValueError as error:
        print(f"articulate_ssl.baselines: {error}", file=sys.stderr)
        return 2
    return 0


def _run(args: argparse.Namespace) -> None:
    kind = method_class(args.method)
    if args.view not in kind.views:
        raise ValueError(f"{kind.title} is defined for {' and '.join(kind.views)} clouds, not {args.view}")
    data = _data(args, kind, args.root, args.source)
    problem = problem_of(data, args.orientation_range)
    tested, report = data, args.out
    if args.test_source is not None:
        tested = _data(args, kind, args.test_root or args.root, args.test_source, str(data.folder))
        report = args.out / f"tested-on-{args.test_source}"
        other = problem_of(tested)
        if (other.num_parts, other.joint_type) != (problem.num_parts, problem.joint_type):
            raise ValueError(f"{tested.folder}: has other parts or joints than {data.folder}, which trains")
    method = seeded(kind, problem, args.seed, args.steps)
    with shown():
        note = train(method, data, args.out, args.seed)
        test(method, tested, report, note)


def _data(
    args: argparse.Namespace, kind: type[Method], root: str, source: str, calibration_set: str | None = None
) -> ArticulatedDataModule:
    return ArticulatedDataModule(
        args.category,
        root,
        source,
        args.view,
        args.protocol,
        num_points=args.points,
        batch_size=args.batch_size or kind.effort.batch_size,
        seed=args.seed,
        val_samples=0,
        max_test_samples=args.samples,
        dense_in_fit=True,
        calibration_set=calibration_set,
        occupancy=OCCUPANCY in kind.given,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m articulate_ssl.baselines",
        description=main.__doc__.partition("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("method", choices=METHODS, metavar="NAME", help=", ".join(METHODS))
    add("--category", required=True)
    add("--root", default="data", help="folder that `make data` wrote to")
    add("--source", default="procedural")
    add("--test-source", help="test on objects of this source instead of the set's own test split")
    add("--test-root", help="folder of that set; default: --root")
    add("--view", default="complete", choices=VIEWS)
    add("--protocol", choices=PROTOCOLS, help="of partial views; default: honest")
    add("--seed", type=int, default=0, help="of weights, order and rotations")
    add("--steps", type=int, help="of training; default: the method's own")
    add("--batch-size", type=int, help="default: the method's own")
    # 512 are what registration and labelling read of a cloud in `lightning test` (`InferenceOptions.points`).
    add("--points", type=int, default=512, help="points of an input cloud")
    add("--samples", type=int, default=900, help="test clouds, spread over instances and states")
    add("--orientation-range", type=float, default=180.0, help="how far objects are turned from their mean at most")
    add("--out", type=Path, required=True, help="folder of weights and report; what it holds is used again")
    return parser


if __name__ == "__main__":
    sys.exit(main())
