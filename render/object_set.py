"""A data set of posed objects: which objects are in which split, and its manifest."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from datamodules.manifest import SPLITS, Manifest, ShardEntry
from render.category import CategorySpec
from render.journal import Contents, contents_of, generator_version
from render.reading import broken, read_all
from render.shard_task import ObjectCheck, SetOptions, ShardResult, ShardTask, plan_shards


@dataclass(frozen=True)
class ObjectSet:
    """What a set of posed objects is made of.

    Attributes:
        options: Of the set.
        instances: Instance ids of each split.
        left_out: Why, by id, other objects of the source are not in it.
        checksums: SHA-256 of each instance as it was read; empty of procedural ones.
    """

    options: SetOptions
    instances: dict[str, tuple[str, ...]]
    left_out: dict[str, str]
    checksums: dict[str, str] = field(default_factory=dict)

    @property
    def contents(self) -> Contents:
        """For comparison with a set that was made, or begun, before."""
        return contents_of(self.instances, self.left_out, self.checksums)

    def tasks(self, folder: Path) -> list[ShardTask]:
        """The shards, in order."""
        return [task for split in SPLITS for task in plan_shards(self.options, folder, split, self.instances[split])]

    def check(self, first: ShardResult, other: ShardResult) -> None:
        """Raise ValueError if two shards differ in their parts or joints."""
        if (first.joint_types, len(first.part_names)) != (other.joint_types, len(other.part_names)):
            raise ValueError(
                f"instances {first.instance_id!r} (parts {', '.join(first.part_names)}) and {other.instance_id!r} "
                f"(parts {', '.join(other.part_names)}) differ in their parts or joints; make a set of each kind"
            )

    def manifest(self, results: list[ShardResult]) -> Manifest:
        """Of the finished set, from the results of its tasks in order."""
        options = self.options
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
            instances=self.instances,
            rest_state={result.instance_id: tuple(result.rest_state) for result in results},
            shards=shard_entries(results),
            rejected_views=sum(result.rejected_views for result in results),
            left_out=self.left_out,
            checksums=self.checksums,
        )


def plan_objects(
    options: SetOptions,
    train: int | None,
    test: int | None,
    skip_broken: bool,
    workers: int,
    scheduler: str | None,
) -> ObjectSet:
    """Read a source's objects and choose those of the set. The procedural ones have no files and are not read.

    Args:
        options: Of the set, except for `train_instances` and `test_instances`.
        train: Number of training instances; None for the category's own.
        test: The same for test.
        skip_broken: Leave out the objects that cannot be used.
        workers: Processes.
        scheduler: See `render.execution.run_tasks`.

    Raises:
        ValueError: if the source cannot be opened, has too few instances, or unusable ones that are not to be left out.
    """
    source = options.open()
    ids, unusable, checksums = source.instance_ids(), {}, {}
    if options.root is not None:
        checks = [ObjectCheck(options, instance_id) for instance_id in ids]
        readings = read_all(checks, workers, scheduler, f"reading {options.category} objects")
        unusable = broken(readings, options.root, "objects", skip_broken)
        ids = [instance_id for instance_id in ids if instance_id not in unusable]
    by_default = default_split(options.spec, len(ids))
    options = replace(
        options,
        train_instances=by_default[0] if train is None else train,
        test_instances=by_default[1] if test is None else test,
    )
    instances = split_instances(options, ids)
    left_out = dict(source.left_out()) | unusable
    if options.root is not None:
        counts = f"--train-instances {options.train_instances} and --test-instances {options.test_instances}"
        checksums = {i: readings[i].checksum for split in SPLITS for i in instances[split]}
        left_out |= dict.fromkeys((i for i in ids if i not in checksums), f"more than {counts} take")
    return ObjectSet(options, instances, left_out, checksums)


def split_instances(options: SetOptions, ids: list[str]) -> dict[str, tuple[str, ...]]:
    """Instance ids of the splits: the first ones train, the next ones test.

    Raises:
        ValueError: if there are too few, or none is wanted.
    """
    train, test = options.train_instances, options.test_instances
    if train + test == 0:
        raise ValueError("--train-instances and --test-instances are both 0: there is nothing to make")
    if train + test > len(ids):
        raise ValueError(
            f"source {options.source!r} has {len(ids)} instances of {options.category}, too few for {train} "
            f"training and {test} test instances; pass smaller --train-instances and --test-instances"
        )
    return {"train": tuple(ids[:train]), "test": tuple(ids[train : train + test])}


def default_split(spec: CategorySpec, available: int) -> tuple[int, int]:
    """Numbers of training and test instances: the category's own, or all in the same ratio where there are fewer."""
    train, test = spec.train_instances, spec.test_instances
    if train + test > available:
        test = min(max(1, round(available * test / (train + test))), available)
        train = available - test
    return train, test


def shard_entries(results: list[ShardResult]) -> dict[str, tuple[ShardEntry, ...]]:
    """The shards of each split, as a manifest lists them."""
    return {
        split: tuple(ShardEntry(r.name, r.samples, r.sha256) for r in results if r.split == split) for split in SPLITS
    }
