"""`python -m articulate_ssl.comparison --categories laptop`: train, test and tabulate every method."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from articulate_ssl.comparison.figure import draw
from articulate_ssl.comparison.jobs import SAMPLES, Job, Setting, make_data
from articulate_ssl.comparison.measured import Measured
from articulate_ssl.comparison.results import collect
from articulate_ssl.comparison.rows import learners, rows_of
from articulate_ssl.comparison.spread import do_jobs
from articulate_ssl.comparison.table import as_csv, as_json, as_markdown
from articulate_ssl.ops.idle_threads import sleep_soon
from articulate_ssl.pretrained.rebuild import CATEGORIES
from articulate_ssl.pretrained.stages import StageFailed
from datamodules.atomic import atomic_write
from datamodules.manifest import VIEWS

_EVERY = "all"
_FAILED, _BAD_INPUT = 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the tables.

    Returns:
        Exit code: 0; 1 if something failed, which the table then lacks; 2 for bad options.
    """
    args = _parser().parse_args(arguments)
    categories = CATEGORIES if args.categories == [_EVERY] else tuple(args.categories)
    names = tuple(args.methods) or learners()
    sleep_soon()  # the programs that this one starts
    if args.workers > 1 and args.scheduler is None:
        # Parallelism comes from workers then; programs that share cores by threads slow each other down.
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // args.workers)))
    try:
        for name in names:
            rows_of(name)
        done = [_compare(category, names, args) for category in categories]
    except (ValueError, OSError) as error:
        print(f"articulate_ssl.comparison: {error}", file=sys.stderr)
        return _BAD_INPUT
    return 0 if all(done) else _FAILED


def _compare(category: str, names: tuple[str, ...], args: argparse.Namespace) -> bool:
    """One table; whether nothing failed."""
    root = args.root or args.build / "data"
    setting = Setting(
        category,
        args.view,
        args.build,
        root,
        args.samples,
        args.steps,
        tuple(args.configs),
        tuple(args.data_options),
        args.test_source,
        args.test_root,
    )
    measured = Measured(args.measured)
    # One seed of all first, so that an early table is whole.
    defined = [name for name in names if any(args.view in row.views for row in rows_of(name))]
    jobs = [Job(setting, name, seed) for seed in range(args.seeds) for name in defined]
    failed: dict[Job, str] = {}

    def keep(*some: Job) -> None:
        for file in measured.keep(some):
            _say(f"{file}: kept")

    keep(*jobs)
    missing = [job for job in jobs if not (job.finished or measured.knows(job))]
    if missing and not args.show:
        try:
            make_data(setting, tuple(job.learner for job in missing), _say)
        except StageFailed as error:
            _say(str(error))
            return False
        failed = do_jobs(missing, args.workers, args.scheduler, keep)
    results = collect(setting, names, range(args.seeds), list(failed.values()), measured)
    args.build.mkdir(parents=True, exist_ok=True)  # where all results were kept, no job made it
    out = args.build / setting.name
    writers: dict[str, Callable] = {".md": as_markdown, ".csv": as_csv, ".json": as_json}
    for suffix, written in writers.items():
        with atomic_write(out.with_name(out.name + suffix)) as file:
            file.write(written(results).encode())
    draw(results, out.with_name(f"{out.name}.png"))
    print(as_markdown(results))
    _say("\n".join(f"{out}{suffix}" for suffix in (*writers, ".png")))
    return not failed


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m articulate_ssl.comparison",
        description="Train and test every method on the same clouds; what is finished is not repeated.",
    )
    add = parser.add_argument
    add("--categories", nargs="+", default=["laptop"], help=f"or {_EVERY}; default: laptop")
    add("--view", default="complete", choices=VIEWS)
    add("--seeds", type=int, default=1, help="trainings of each method; default: 1")
    add("--methods", nargs="*", default=[], metavar="NAME", help=f"default: {', '.join(learners())}")
    add("--build", type=Path, default=Path("build/compare"), help="of tables and trainings; default: build/compare")
    add("--root", type=Path, help="folder that `make data` wrote to; default: data in --build, made if missing")
    add("--test-source", help="test on objects of this source instead, which `make data` made a set of (SOURCE)")
    add("--test-root", type=Path, help="folder of that set (OUT); default: --root")
    add("--samples", type=int, default=SAMPLES, help=f"test clouds; default: {SAMPLES}")
    add("--steps", type=int, help="of each method; default: its own. Recipes have those of their configuration")
    add("--configs", nargs="*", default=[], type=Path, help="configuration files of recipes behind the cpu profile")
    add("--data-options", type=shlex.split, default=[], help="words for the generator, as one argument")
    add("--workers", type=int, default=1, help="jobs at once on this machine; default: 1")
    add("--measured", type=Path, help="folder of results to keep, and to take instead of measuring them again")
    add("--show", action="store_true", help="make tables of what is finished or kept, and run nothing")
    add("--scheduler", help="address of a Dask scheduler (tcp://…) to spread jobs over machines instead")
    return parser


if __name__ == "__main__":
    sys.exit(main())
