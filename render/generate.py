"""The generator behind `make data`: `python -m render.generate --category laptop`.

A set is made shard by shard. Every shard is a function of the options and of an external source's files alone, so any
number of workers, processes or machines makes the same bytes, and an interrupted run continues where it stopped:
finished shards are listed with their checksums in a journal until the manifest replaces it.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datamodules.atomic import remove_leftovers
from datamodules.manifest import MANIFEST_NAME, PROTOCOLS, SPLITS, VIEWS, Manifest, ShardEntry, set_folder
from datamodules.shards import sha256_of
from render import scan_set
from render.arguments import at_least
from render.category import (
    category_names,
    category_text,
    load_category,
    made_category,
    parse_category,
    require_folder_name,
)
from render.complete_cloud import POOL_SIZE
from render.depth_renderer import DepthRenderer, RendererUnavailable
from render.execution import run_tasks
from render.journal import JOURNAL_NAME, Journal, contents_of, described, require_same
from render.object_set import ObjectSet, plan_objects
from render.occupancy import write_occupancy
from render.partial_cloud import RENDERERS
from render.progress import with_progress
from render.scan_set import ScanSet, ScanSetOptions, plan_scans
from render.shard_task import SetOptions, ShardResult
from render.sources import SOURCES, left_out_lines
from render.training_config import joint_type_of, write_training_config

# Options of posed objects only, and their defaults; scans have been posed and seen already.
OBJECT_OPTIONS = {
    "variant": None, "states": 100, "views": 10, "resolution": None, "renderer": "auto", "noise_std": 0.0,
    "occupancy": 0, "range_deg": None,
}  # fmt: skip
# Options of scans only.
SCAN_OPTIONS = {"parts": None, "joint": None, "normalise": None, "on_table": None}

SetPlan = ObjectSet | ScanSet


def generate(plan: SetPlan, out: Path, workers: int, scheduler: str | None = None, occupancy: int = 0) -> Path:
    """Make, complete or repair a data set and return its folder.

    With `occupancy`, training clouds of posed objects get so many occupancy samples each, in files of their own.

    Raises:
        ValueError: if an instance is unsound, or the folder holds a set made with other options or of other files.
        OSError: if the output cannot be written; what is finished stays.
    """
    options = plan.options
    folder = set_folder(out, options.category, options.source, options.view, options.protocol)
    for line in left_out_lines(plan.left_out):
        print(line, file=sys.stderr)
    for split in SPLITS:
        (folder / split).mkdir(parents=True, exist_ok=True)
    with _alone_in(folder):
        for place in (folder, *(folder / split for split in SPLITS)):
            remove_leftovers(place)
        if (folder / MANIFEST_NAME).exists():
            _repair(folder, plan, workers, scheduler)
        else:
            _complete(folder, plan, workers, scheduler)
        if occupancy:
            write_occupancy(plan, folder, occupancy, workers, scheduler)
    return folder


def _complete(folder: Path, plan: SetPlan, workers: int, scheduler: str | None) -> None:
    """Make the shards that the journal does not list as finished, then the manifest."""
    tasks = plan.tasks(folder)
    journal = Journal(folder / JOURNAL_NAME, described(plan.options.recorded(), plan.contents))
    done = {key: result for key, result in journal.read().items() if _intact(folder, result)}
    missing = [task for task in tasks if (task.split, task.name) not in done]
    for result in with_progress(run_tasks(missing, workers, scheduler), len(missing), _description(plan)):
        journal.append(result)
        done[result.split, result.name] = result
        plan.check(next(iter(done.values())), result)
    plan.manifest([done[task.split, task.name] for task in tasks]).save(folder)
    journal.path.unlink()


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder against other generators; a killed process lets go by itself."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise ValueError(f"{folder}: another run is making this set; wait for its end or pass another --out") from error
    finally:
        os.close(descriptor)


def _intact(folder: Path, shard: ShardResult | ShardEntry, split: str | None = None) -> bool:
    path = folder / (split or shard.split) / shard.name
    return path.is_file() and sha256_of(path) == shard.sha256


def _repair(folder: Path, plan: SetPlan, workers: int, scheduler: str | None) -> None:
    """Make the missing and damaged shards of a finished set again."""
    manifest = Manifest.load(folder)
    splits = manifest.instances if manifest.labelled else manifest.scans
    contents = contents_of(splits, manifest.left_out, manifest.checksums)
    found = {"generator_version": manifest.generator_version, **manifest.options, "contents": contents}
    require_same(found, described(plan.options.recorded(), plan.contents), folder)
    entries = {(split, shard.name): shard for split in SPLITS for shard in manifest.shards[split]}
    tasks = plan.tasks(folder)
    if {(task.split, task.name) for task in tasks} != set(entries):
        raise ValueError(f"{folder}: the source has changed since the set was made; delete {folder} and make it anew")
    broken = [task for task in tasks if not _intact(folder, entries[task.split, task.name], task.split)]
    for result in with_progress(run_tasks(broken, workers, scheduler), len(broken), _description(plan)):
        if result.sha256 != entries[result.split, result.name].sha256:
            raise ValueError(
                f"{folder / result.split / result.name}: made again, but its bytes differ from those in the "
                f"manifest: the set came from other software or source files; delete {folder} and make it anew"
            )


def _description(plan: SetPlan) -> str:
    return f"{plan.options.category} {plan.options.view} shards"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m render.generate",
        description="Generate a data set of posed articulated objects with full labels, or of your own scans without.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--category", required=True, help=f"{', '.join(category_names())}, or the .yaml file of yours")
    add("--source", default="procedural", choices=(*SOURCES, scan_set.SOURCE))
    add("--root", help="folder of an external source's data set, or of your scans (--source clouds)")
    add("--view", default="complete", choices=VIEWS)
    add("--protocol", help=f"of partial views: {' or '.join(PROTOCOLS)}", choices=PROTOCOLS, default=PROTOCOLS[0])
    add("--out", type=Path, default=Path("data"))
    add("--workers", type=at_least(1), default=os.cpu_count(), help="processes; 1 works in this process")
    add("--scheduler", help="address of a Dask scheduler (tcp://…) to use instead of local processes")
    add("--seed", type=at_least(0), default=0)
    add("--train-instances", type=at_least(0), help="default: as in the category's specification; of scans 4 in 5")
    add("--test-instances", type=at_least(0), help="default: as in the category's specification; of scans 1 in 5")
    add("--rotations", type=at_least(1), default=10, help="stored rotations of each complete test cloud")
    add("--points", type=at_least(1), default=4096, help="points per cloud")
    add("--skip-broken", action="store_true", help="leave out objects or scans that cannot be used")
    # Their defaults are filled in later: whoever gives one where it means nothing is told so.
    group = parser.add_argument_group("posed objects, all sources but clouds", argument_default=argparse.SUPPRESS)
    add = group.add_argument
    add("--variant", help="of the category's procedural designs, as its specification names it: both_sides of safe")
    add(
        "--range-deg",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="states of hinges in degrees (default: as the category says; 0 is closed, or of eyeglasses unfolded)",
    )
    add("--states", type=at_least(1), help="articulation states per instance (default: 100)")
    add("--views", type=at_least(1), help="depth views of each articulation state (default: 10)")
    add(
        "--resolution",
        type=at_least(16),
        help="of depth images, pixels (default: as the category says)",
    )
    add("--renderer", choices=("auto", *RENDERERS), help="of partial views (default: auto, which is egl if it works)")
    add("--noise-std", type=float, help="of depth, in rest-state bounding-box diagonals (default: 0)")
    add("--occupancy", type=at_least(0), help="samples inside and outside every training cloud's object (default: 0)")
    group = parser.add_argument_group("your own scans, --source clouds", argument_default=argparse.SUPPRESS)
    add = group.add_argument
    add("--parts", type=at_least(2), help="number of parts of a category that has no specification")
    add("--joint", choices=("revolute", "prismatic"), help="type of its joints")
    add(
        "--normalise",
        choices=scan_set.NORMALISE,
        help="scale by the median size of an object's scans (default of complete ones), by each scan's own (default of "
        "depth views), or take points exactly as they are",
    )
    what = "scans also show what their object stands on: find that surface, and take the largest thing on it"
    add("--on-table", action="store_true", help=what)
    return parser


def plan_from(arguments: argparse.Namespace) -> SetPlan:
    """What is to be made, with the defaults filled in; reads an external source whole.

    Raises:
        ValueError: if options contradict each other, or the source cannot be opened or has unusable objects.
    """
    scans = arguments.source == scan_set.SOURCE
    for name in OBJECT_OPTIONS if scans else SCAN_OPTIONS:
        if hasattr(arguments, name):
            raise ValueError(f"source {arguments.source!r} takes no --{name.replace('_', '-')}")
    if (arguments.root is None) != (arguments.source == "procedural"):
        need = "takes no" if arguments.source == "procedural" else "needs a"
        raise ValueError(f"source {arguments.source!r} {need} --root")
    arguments = argparse.Namespace(**OBJECT_OPTIONS | SCAN_OPTIONS | vars(arguments))
    chosen = arguments.train_instances, arguments.test_instances, arguments.skip_broken
    running = arguments.workers, arguments.scheduler
    if scans:
        plan, lines = plan_scans(_scan_options(arguments), *chosen, *running)
        for line in lines:
            print(line, file=sys.stderr)
        return plan
    return plan_objects(_object_options(arguments), *chosen, *running)


def _object_options(arguments: argparse.Namespace) -> SetOptions:
    spec = load_category(arguments.category, arguments.variant)
    if not 0 <= arguments.noise_std < 1:
        raise ValueError(f"--noise-std must be in [0, 1), not {arguments.noise_std}")
    if arguments.view == "complete" and arguments.points > POOL_SIZE:
        raise ValueError(f"--points must be at most {POOL_SIZE} of complete clouds, not {arguments.points}")
    built_in = arguments.category in category_names()
    return SetOptions(
        category=spec.name,
        source=arguments.source,
        root=arguments.root,
        view=arguments.view,
        protocol=arguments.protocol if arguments.view == "partial" else None,
        seed=arguments.seed,
        train_instances=0,
        test_instances=0,
        states=arguments.states,
        rotations=arguments.rotations,
        views=arguments.views,
        resolution=arguments.resolution or spec.view.resolution,
        points=arguments.points,
        noise_std=arguments.noise_std,
        renderer=choose_renderer(arguments.renderer) if arguments.view == "partial" else None,
        variant=arguments.variant,
        specification=None if built_in else category_text(arguments.category)[1],
        range_deg=None if arguments.range_deg is None else tuple(arguments.range_deg),
    )


def _scan_options(arguments: argparse.Namespace) -> ScanSetOptions:
    if arguments.view == "partial" and arguments.protocol != "honest":
        raise ValueError(f"--protocol {arguments.protocol}: of scans, nothing is known but what was seen; leave it out")
    name, text = _scanned_category(arguments.category, arguments.parts, arguments.joint)
    joint_type_of(parse_category(name, text))
    return ScanSetOptions(
        category=name,
        specification=text,
        root=arguments.root,
        view=arguments.view,
        protocol="honest" if arguments.view == "partial" else None,
        seed=arguments.seed,
        train_instances=0,
        test_instances=0,
        rotations=arguments.rotations,
        points=arguments.points,
        normalise=arguments.normalise or ("scan" if arguments.view == "partial" else "object"),
        on_table=arguments.on_table,
    )


def _scanned_category(category: str, parts: int | None, joint: str | None) -> tuple[str, str]:
    """Name and YAML of the category of scans: what --parts and --joint say, or a built-in one's, or the user's file."""
    known = category in category_names() or Path(category).suffix in (".yaml", ".yml")
    if known and (parts is not None or joint is not None):
        raise ValueError(f"category {category!r} says what its parts and joints are; leave --parts and --joint out")
    if known:
        return category_text(category)
    if parts is None or joint is None:
        raise ValueError(
            f"category {category!r} is not built in: say --parts <number> and --joint revolute (or prismatic), or name "
            "its file, --category path/to/it.yaml; docs/own_data.md shows one"
        )
    require_folder_name(category)
    return category, made_category(parts, joint)


def choose_renderer(wanted: str) -> str:
    """Name of the renderer to use; says so on stderr if `auto` has to do without EGL.

    Raises:
        ValueError: if `egl` is wanted and does not work.
    """
    if wanted == "ray-caster":
        return wanted
    try:
        DepthRenderer([])
    except RendererUnavailable as error:
        remedy = "install libegl1 and libgl1"
        if wanted == "egl":
            raise ValueError(f"{error}; {remedy}, or use --renderer ray-caster") from error
        print(f"{error}; using the slower ray caster instead. For speed {remedy}.", file=sys.stderr)
        return "ray-caster"
    return "egl"


def main(argv: list[str] | None = None) -> int:
    """Command line; 2 with one message on stderr for bad arguments, bad input and output that cannot be written."""
    arguments = _parser().parse_args(argv)
    try:
        plan = plan_from(arguments)
        occupancy = getattr(arguments, "occupancy", OBJECT_OPTIONS["occupancy"])
        folder = generate(plan, arguments.out, arguments.workers, arguments.scheduler, occupancy)
        manifest = Manifest.load(folder)
        lines = _training_lines(plan, folder, arguments.out)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; repeat the command to continue", file=sys.stderr)
        return 130
    counts = ", ".join(f"{manifest.num_samples(split)} {split}" for split in SPLITS)
    print(f"{folder}: {counts} samples")
    for line in lines:
        print(line)
    return 0


def _training_lines(plan: SetPlan, folder: Path, out: Path) -> list[str]:
    """How to train on scans; categories of objects have configurations."""
    if not isinstance(plan, ScanSet):
        return []
    options = plan.options
    return write_training_config(folder, out, options.source, options.spec, options.view, options.points)


if __name__ == "__main__":
    sys.exit(main())
