"""The generator behind `make data`: `python -m render.generate --category laptop`.

A set is made shard by shard. Every shard is a function of the options alone, so any number of workers, processes or
machines makes the same bytes, and an interrupted run continues where it stopped: finished shards are listed with their
checksums in a journal until the manifest replaces it.
"""

from __future__ import annotations

import argparse
import fcntl
import importlib.metadata
import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

from datamodules.atomic import atomic_write, remove_leftovers
from datamodules.manifest import MANIFEST_NAME, PROTOCOLS, SPLITS, VIEWS, Manifest, ShardEntry, set_folder
from datamodules.shards import sha256_of
from render.category import CategorySpec, category_names, load_category
from render.depth_renderer import DepthRenderer, RendererUnavailable
from render.execution import run_tasks
from render.partial_cloud import RENDERERS
from render.shard_task import SetOptions, ShardResult, ShardTask, plan_shards
from render.sources import SOURCES, Source, left_out_lines, open_source

JOURNAL_NAME = ".journal.jsonl"


def generate(options: SetOptions, out: Path, workers: int, scheduler: str | None = None) -> Path:
    """Make, complete or repair a data set and return its folder.

    Raises:
        ValueError: if an option or an instance is unsound, or the folder holds a set made with other options.
        OSError: if the output cannot be written; what is finished stays.
    """
    folder = set_folder(out, options.category, options.source, options.view, options.protocol)
    ids = split_instances(options)
    left_out = _left_out(options, ids)
    for line in left_out_lines(left_out):
        print(line, file=sys.stderr)
    for split in SPLITS:
        (folder / split).mkdir(parents=True, exist_ok=True)
    with _alone_in(folder):
        for place in (folder, *(folder / split for split in SPLITS)):
            remove_leftovers(place)
        tasks = [task for split in SPLITS for task in plan_shards(options, folder, split, ids[split])]
        if (folder / MANIFEST_NAME).exists():
            _repair(folder, options, tasks, workers, scheduler)
        else:
            _complete(folder, options, ids, left_out, tasks, workers, scheduler)
    return folder


def _complete(
    folder: Path,
    options: SetOptions,
    ids: dict[str, tuple[str, ...]],
    left_out: dict[str, str],
    tasks: list[ShardTask],
    workers: int,
    scheduler: str | None,
) -> None:
    """Make the shards that the journal does not list as finished, then the manifest."""
    journal = Journal(folder / JOURNAL_NAME, options)
    done = {key: result for key, result in journal.read().items() if _intact(folder, result)}
    missing = [task for task in tasks if (task.split, task.name) not in done]
    for result in _with_progress(run_tasks(missing, workers, scheduler), len(missing), options):
        journal.append(result)
        done[result.split, result.name] = result
        _require_same_structure(next(iter(done.values())), result)
    results = [done[task.split, task.name] for task in tasks]
    _manifest(options, ids, left_out, results).save(folder)
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


def split_instances(options: SetOptions) -> dict[str, tuple[str, ...]]:
    """Instance ids of the splits: the first ones of the source train, the next ones test.

    Raises:
        ValueError: if the source has too few instances.
    """
    ids = _open(options).instance_ids()
    train, test = options.train_instances, options.test_instances
    if train + test > len(ids):
        raise ValueError(
            f"source {options.source!r} has {len(ids)} instances of {options.category}, too few for {train} "
            f"training and {test} test instances; pass smaller --train-instances and --test-instances"
        )
    return {"train": tuple(ids[:train]), "test": tuple(ids[train : train + test])}


def _open(options: SetOptions | argparse.Namespace) -> Source:
    spec, root = load_category(options.category, options.variant), None if options.root is None else Path(options.root)
    return open_source(options.source, spec, root, options.seed)


def _left_out(options: SetOptions, ids: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Why, by id, objects of the source are not in the set; the procedural source has no end to be left out of."""
    source = _open(options)
    left_out = dict(source.left_out())
    if options.root is not None:
        counts = f"--train-instances {options.train_instances} and --test-instances {options.test_instances}"
        used = {instance_id for split in SPLITS for instance_id in ids[split]}
        left_out |= dict.fromkeys((i for i in source.instance_ids() if i not in used), f"more than {counts} take")
    return left_out


def default_split(spec: CategorySpec, available: int) -> tuple[int, int]:
    """Numbers of training and test instances: the category's own, or all in the same ratio where there are fewer."""
    train, test = spec.train_instances, spec.test_instances
    if train + test > available:
        test = min(max(1, round(available * test / (train + test))), available)
        train = available - test
    return train, test


class Journal:
    """The finished shards of a set that is being made: one JSON line for the options, one for every shard."""

    def __init__(self, path: Path, options: SetOptions) -> None:
        """Open or start a journal.

        Raises:
            ValueError: if another set was begun in this folder.
        """
        self.path = path
        lines = self._lines() or [_described(options)]
        _require_same_options(lines[0], _described(options), path.parent)
        with atomic_write(path) as file:  # without a line that a killed run left unfinished
            file.writelines(json.dumps(line).encode() + b"\n" for line in lines)

    def append(self, result: ShardResult) -> None:
        """Note a finished shard."""
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(result)) + "\n")

    def read(self) -> dict[tuple[str, str], ShardResult]:
        """Finished shards by split and name."""
        results = [ShardResult(**{key: _tuples(value) for key, value in line.items()}) for line in self._lines()[1:]]
        return {(result.split, result.name): result for result in results}

    def _lines(self) -> list[dict]:
        """All complete lines."""
        if not self.path.exists():
            return []
        lines = []
        for text in self.path.read_text(encoding="utf-8").splitlines():
            try:
                lines.append(json.loads(text))
            except json.JSONDecodeError:
                continue
        return lines


def _tuples(value):
    """JSON lists back as the tuples they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _described(options: SetOptions) -> dict:
    """The options as they come back from a JSON file."""
    return json.loads(json.dumps({"generator_version": generator_version(), **options.recorded()}))


def generator_version() -> str:
    """Version of the installed package."""
    return importlib.metadata.version("articulate-ssl")


def _require_same_options(found: dict, wanted: dict, folder: Path) -> None:
    different = [f"{key} {found.get(key)!r}, now {value!r}" for key, value in wanted.items() if found.get(key) != value]
    if different:
        raise ValueError(
            f"{folder} holds a set made with other options ({'; '.join(different)}); delete that folder, pass another "
            f"--out, or repeat the options"
        )


def _intact(folder: Path, shard: ShardResult | ShardEntry, split: str | None = None) -> bool:
    path = folder / (split or shard.split) / shard.name
    return path.is_file() and sha256_of(path) == shard.sha256


def _repair(folder: Path, options: SetOptions, tasks: list[ShardTask], workers: int, scheduler: str | None) -> None:
    """Make the missing and damaged shards of a finished set again."""
    manifest = Manifest.load(folder)
    found = {"generator_version": manifest.generator_version, **manifest.options}
    _require_same_options(found, _described(options), folder)
    entries = {(split, shard.name): shard for split in SPLITS for shard in manifest.shards[split]}
    broken = [task for task in tasks if not _intact(folder, entries[task.split, task.name], task.split)]
    for result in _with_progress(run_tasks(broken, workers, scheduler), len(broken), options):
        if result.sha256 != entries[result.split, result.name].sha256:
            raise ValueError(
                f"{folder / result.split / result.name}: made again, but its bytes differ from those in the "
                f"manifest: the set came from other software or source files; delete {folder} and make it anew"
            )


def _with_progress(results: Iterable[ShardResult], total: int, options: SetOptions) -> Iterable[ShardResult]:
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not sys.stderr.isatty()) as progress:
        yield from progress.track(results, total=total, description=f"{options.category} {options.view} shards")


def _require_same_structure(first: ShardResult, other: ShardResult) -> None:
    if (first.joint_types, len(first.part_names)) != (other.joint_types, len(other.part_names)):
        raise ValueError(
            f"instances {first.instance_id!r} (parts {', '.join(first.part_names)}) and {other.instance_id!r} (parts "
            f"{', '.join(other.part_names)}) differ in their parts or joints; make a set of each kind"
        )


def _manifest(
    options: SetOptions, ids: dict[str, tuple[str, ...]], left_out: dict[str, str], results: list[ShardResult]
) -> Manifest:
    rest = {result.instance_id: tuple(result.rest_state) for result in results}
    ranges = [result.articulation_range for result in results]
    return Manifest(
        generator_version=generator_version(),
        options=options.recorded(),
        seed=options.seed,
        category=options.category,
        source=options.source,
        view=options.view,
        protocol=options.protocol,
        part_names=results[0].part_names,
        joint_types=results[0].joint_types,
        articulation_range=tuple(
            (min(r[j][0] for r in ranges), max(r[j][1] for r in ranges)) for j in range(len(ranges[0]))
        ),
        instances=ids,
        rest_state=rest,
        shards={
            split: tuple(ShardEntry(r.name, r.samples, r.sha256) for r in results if r.split == split)
            for split in SPLITS
        },
        rejected_views=sum(result.rejected_views for result in results),
        left_out=left_out,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m render.generate",
        description="Generate a data set of posed articulated objects with full labels.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--category", required=True, choices=category_names())
    add("--source", default="procedural", choices=tuple(SOURCES))
    add("--root", help="folder of an external source's data set")
    add("--variant", help="of the category's procedural designs, as its specification names it: both_sides of safe")
    add("--view", default="complete", choices=VIEWS)
    add("--protocol", default="honest", choices=PROTOCOLS, help="of partial views")
    add("--out", type=Path, default=Path("data"))
    add("--workers", type=_at_least(1), default=os.cpu_count(), help="processes; 1 works in this process")
    add("--scheduler", help="address of a Dask scheduler (tcp://…) to use instead of local processes")
    add("--seed", type=_at_least(0), default=0)
    add("--train-instances", type=_at_least(0), help="default: as the category's specification")
    add("--test-instances", type=_at_least(0), help="default: as in the category's specification")
    add("--states", type=_at_least(1), default=100, help="articulation states per instance")
    add("--rotations", type=_at_least(1), default=10, help="stored rotations of each complete test cloud")
    add("--views", type=_at_least(1), default=10, help="depth views of each articulation state")
    add("--resolution", type=_at_least(16), help="of depth images, pixels; default: as in the category's specification")
    add("--points", type=_at_least(1), default=4096, help="points per cloud")
    add("--renderer", choices=("auto", *RENDERERS), default="auto", help="of partial views; auto: egl if it works")
    add("--noise-std", type=float, default=0.0, help="of depth, in rest-state bounding-box diagonals")
    return parser


def _at_least(smallest: int):
    def integer(text: str) -> int:
        if (value := int(text)) < smallest:
            raise argparse.ArgumentTypeError(f"must be at least {smallest}, not {value}")
        return value

    return integer


def options_from(arguments: argparse.Namespace) -> SetOptions:
    """The options of a set, with the category's defaults filled in.

    Raises:
        ValueError: if they contradict each other, or the source cannot be opened.
    """
    spec = load_category(arguments.category)
    if (arguments.root is None) != (arguments.source == "procedural"):
        need = "takes no" if arguments.source == "procedural" else "needs a"
        raise ValueError(f"source {arguments.source!r} {need} --root")
    if not 0 <= arguments.noise_std < 1:
        raise ValueError(f"--noise-std must be in [0, 1), not {arguments.noise_std}")
    ids = _open(arguments).instance_ids()
    train, test = default_split(spec, len(ids))
    train = train if arguments.train_instances is None else arguments.train_instances
    test = test if arguments.test_instances is None else arguments.test_instances
    if train + test == 0:
        raise ValueError("--train-instances and --test-instances are both 0: there is nothing to make")
    return SetOptions(
        category=spec.name,
        source=arguments.source,
        root=arguments.root,
        view=arguments.view,
        protocol=arguments.protocol if arguments.view == "partial" else None,
        seed=arguments.seed,
        train_instances=train,
        test_instances=test,
        states=arguments.states,
        rotations=arguments.rotations,
        views=arguments.views,
        resolution=arguments.resolution or spec.view.resolution,
        points=arguments.points,
        noise_std=arguments.noise_std,
        renderer=choose_renderer(arguments.renderer) if arguments.view == "partial" else None,
        variant=arguments.variant,
    )


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
        folder = generate(options_from(arguments), arguments.out, arguments.workers, arguments.scheduler)
        manifest = Manifest.load(folder)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; repeat the command to continue", file=sys.stderr)
        return 130
    counts = ", ".join(f"{manifest.num_samples(split)} {split}" for split in SPLITS)
    print(f"{folder}: {counts} samples")
    return 0


if __name__ == "__main__":
    sys.exit(main())
