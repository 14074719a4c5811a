"""A data set of scans that nobody labelled (`SOURCE=clouds`): which scans, of which objects, split and scaled how.

The folders in the root are objects, and what lies in one, at any depth, are scans of it; a scan directly in the root is
an object of its own. Clouds are chosen and ordered as rendered ones are (`render.scan_cloud`). Every shard is a
function of the options and the scans alone.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from datamodules.manifest import SPLITS, Manifest
from datamodules.point_cloud_io import SUFFIXES, read_scan
from datamodules.shards import SHARD_ARRAYS, UNLABELLED_ARRAYS, sha256_of, write_shard
from datamodules.standing_object import standing_object
from render.category import CategorySpec, parse_category
from render.journal import Contents, contents_of, generator_version
from render.object_set import shard_entries
from render.posing import sample_rotation
from render.reading import broken, read_all
from render.scan_cloud import choose_points, refuse_camera, size_of
from render.seeds import generator_for
from render.shard_task import SAMPLES_PER_SHARD, Reading, ShardResult
from render.sources.dataset_folder import files_below

SOURCE = "clouds"
NORMALISE = ("object", "scan", "none")
TEST_SHARE = 5  # one object in five is for test, of a single object one scan in five
# Scans of one object differ in size because it is open or closed, or seen from the side; other units differ by ten.
_SAME_UNIT = 3.0
_NAMED = 5  # scans, in a line about many
_FEW_SCANS = 24  # to try splits on (`split_clouds` of discovery); it goes on with fewer

Scans = tuple[tuple[str, int], ...]  # path below the root, and index of the object, of every scan of a split


@dataclass(frozen=True)
class ScanSetOptions:
    """Everything that decides, with the scans, the bytes of a set.

    Attributes:
        category: Name of the category.
        specification: Its YAML.
        root: Folder of the scans.
        view: `complete` or `partial`.
        protocol: `honest` for partial views, None for complete clouds.
        seed: Of everything random.
        train_instances: Number of objects for training.
        test_instances: The same for test; a single object may be in both.
        rotations: Stored orientations of each complete test scan: as it was scanned, and random ones.
        points: Points per cloud.
        normalise: `object`: centred, and scaled by the median size of the scans of its object; `scan`: by its own size;
            `none`: taken as it is, to the bit and in its order, because the user has done all that.
        on_table: Scans also show what their object stands on, from which it is cut out. None, as sets from before there
            was this option have it, stands for no.
    """

    category: str
    specification: str
    root: str
    view: str
    protocol: str | None
    seed: int
    train_instances: int
    test_instances: int
    rotations: int
    points: int
    normalise: str
    on_table: bool | None = None

    source = SOURCE

    @property
    def spec(self) -> CategorySpec:
        """The category; only its parts and joints matter here."""
        return parse_category(self.category, self.specification)

    def copies(self, split: str) -> int:
        """Stored samples of each scan."""
        return self.rotations if split == "test" and self.view == "complete" else 1

    def recorded(self) -> dict:
        """The options as the manifest records them; of `root` only the folder name, wherever it lies."""
        return asdict(self) | {"source": SOURCE, "root": Path(self.root).resolve().name}

    def cloud(self, scan: str) -> tuple[np.ndarray, tuple[str, ...]]:  # [P, 3]
        """The points of a scan that are stored, in its own units, and what its user should know about it.

        Raises:
            ValueError: naming the file, if it cannot be used.
        """
        path = os.path.join(self.root, scan)
        read = read_scan(path)
        read = standing_object(path, read) if self.on_table else read
        try:
            if self.view == "partial":
                refuse_camera(read.points)
            if self.normalise == "none":
                if len(read.points) != self.points:
                    raise ValueError(f"has {len(read.points)} points; --normalise none needs --points {self.points}")
                return read.points, read.notes
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        few = (f"fewer than {self.points} points, which are repeated",)
        notes = read.notes + (few if len(read.points) < self.points else ())
        return choose_points(read.points, self.points, self.view, generator_for(self.seed, "scan", scan)), notes


@dataclass(frozen=True)
class ScanReading(Reading):
    """What came of reading a scan.

    Attributes:
        size: See `render.scan_cloud.size_of`; in the scan's unit.
        notes: What its user should know.
    """

    size: float = 0.0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScanCheck:
    """Read a scan, before any shard is made."""

    options: ScanSetOptions
    scan: str

    def make(self) -> ScanReading:
        """Whether it can be used, and how large it is."""
        try:
            points, notes = self.options.cloud(self.scan)
        except (ValueError, OSError) as error:
            return ScanReading(self.scan, str(error))
        checksum = sha256_of(os.path.join(self.options.root, self.scan))
        return ScanReading(self.scan, checksum=checksum, size=size_of(points), notes=notes)


@dataclass(frozen=True)
class ScanShardTask:
    """One shard of scans.

    Attributes:
        options: Of the set.
        folder: Of the set.
        split: `train` or `test`.
        name: Of the shard.
        scans: In order, with the index of their object.
        scales: By which each is divided.
    """

    options: ScanSetOptions
    folder: str
    split: str
    name: str
    scans: Scans
    scales: tuple[float, ...]

    def make(self) -> ShardResult:
        """Write the shard.

        Raises:
            ValueError: if a scan has become unusable.
            OSError: if the shard cannot be written.
        """
        options, samples = self.options, []
        for (scan, instance), scale in zip(self.scans, self.scales, strict=True):
            points, _ = options.cloud(scan)
            center = np.zeros(3) if options.normalise == "none" else points.mean(axis=0)
            for copy in range(options.copies(self.split)):
                seen, seen_center = points, center
                if copy:  # the first one is as it was scanned
                    rotation = sample_rotation(generator_for(options.seed, "rotation", scan, copy))
                    seen, seen_center = (np.einsum("ab,...b->...a", rotation, x) for x in (points, center))
                normalised = (seen - seen_center) / scale
                samples.append({"points": normalised, "instance": instance, "center": seen_center, "scale": scale})
        arrays = {n: np.array([s[n] for s in samples], dtype=SHARD_ARRAYS[n].dtype) for n in UNLABELLED_ARRAYS}
        path = Path(self.folder) / self.split / self.name
        return ShardResult(self.split, self.name, len(samples), write_shard(path, arrays))


@dataclass(frozen=True)
class ScanSet:
    """What a set of scans is made of.

    Attributes:
        options: Of the set.
        instances: Object ids of each split.
        scans: Scans of each split.
        scales: By which each scan is divided.
        left_out: Why, by id, other scans or objects are not in it.
        split_by: `instance` or `scan`.
        checksums: SHA-256 of the file of each scan.
    """

    options: ScanSetOptions
    instances: dict[str, tuple[str, ...]]
    scans: dict[str, Scans]
    scales: dict[str, float]
    left_out: dict[str, str]
    split_by: str
    checksums: dict[str, str]

    @property
    def contents(self) -> Contents:
        """For comparison with a set that was made, or begun, before."""
        return contents_of(self.files, self.left_out, self.checksums)

    @property
    def files(self) -> dict[str, tuple[str, ...]]:
        """Paths of each split's scans below the root, in the order of the samples."""
        return {split: tuple(scan for scan, _ in self.scans[split]) for split in SPLITS}

    def tasks(self, folder: Path) -> list[ScanShardTask]:
        """The shards, in order."""
        tasks = []
        for split in SPLITS:
            step = max(1, SAMPLES_PER_SHARD // self.options.copies(split))
            for number, first in enumerate(range(0, len(self.scans[split]), step)):
                scans = self.scans[split][first : first + step]
                scales = tuple(self.scales[scan] for scan, _ in scans)
                tasks.append(ScanShardTask(self.options, str(folder), split, f"shard-{number:05d}.npz", scans, scales))
        return tasks

    def check(self, first: ShardResult, other: ShardResult) -> None:
        """All clouds are alike."""

    def manifest(self, results: list[ShardResult]) -> Manifest:
        """Of the finished set, from the results of its tasks in order."""
        options, spec = self.options, self.options.spec
        return Manifest(
            generator_version=generator_version(),
            options=options.recorded(),
            seed=options.seed,
            category=options.category,
            source=SOURCE,
            view=options.view,
            protocol=options.protocol,
            part_names=spec.parts,
            joint_types=tuple(joint.type for joint in spec.joints),
            articulation_range=(),
            instances=self.instances,
            rest_state={},
            shards=shard_entries(results),
            left_out=self.left_out,
            labelled=False,
            split_by=self.split_by,
            scans=self.files,
            checksums=self.checksums,
        )


def plan_scans(
    options: ScanSetOptions,
    train: int | None,
    test: int | None,
    skip_broken: bool,
    workers: int,
    scheduler: str | None,
) -> tuple[ScanSet, list[str]]:
    """Read all scans below a folder, and choose split and scale of each.

    Args:
        options: Of the set, except for `train_instances` and `test_instances`.
        train: Number of objects for training; None for all that are not for test.
        test: The same for test; None for one in five.
        skip_broken: Leave out the scans that cannot be used.
        workers: Processes.
        scheduler: See `render.execution.run_tasks`.

    Returns:
        The plan, and lines for the user to read.

    Raises:
        ValueError: if there are no scans or too few, or unusable ones that are not to be left out.
    """
    found, ignored = find_scans(options.root)
    lines = [f"ignored {count} file(s) {suffix or 'without suffix'}: no point clouds" for suffix, count in ignored]
    readings = read_all(
        [ScanCheck(options, scan) for scan in found], workers, scheduler, f"reading {options.category} scans"
    )
    unusable = broken(readings, options.root, "scans", skip_broken)
    objects: dict[str, list[str]] = {}
    for scan in found:
        if scan not in unusable:
            objects.setdefault(object_of(scan), []).append(scan)
    lines += _note_lines(readings)
    scales, of_scales = _scales(options, objects, readings)
    instances, scans, split_by = split_objects(objects, train, test)
    used = {name for split in SPLITS for name in instances[split]}
    counts = f"--train-instances {train} and --test-instances {test}"
    left_out = unusable | dict.fromkeys((name for name in objects if name not in used), f"more than {counts} take")
    if len(scans["train"]) < _FEW_SCANS and scans["train"]:
        lines.append(
            f"only {len(scans['train'])} scans to train on: parts are found by comparing scans of many joint states; "
            "docs/own_data.md says how many"
        )
    numbers = {f"{split}_instances": len(instances[split]) for split in SPLITS}
    checksums = {scan: readings[scan].checksum for split in SPLITS for scan, _ in scans[split]}
    plan = ScanSet(replace(options, **numbers), instances, scans, scales, left_out, split_by, checksums)
    return plan, lines + of_scales


def find_scans(root: str) -> tuple[list[str], list[tuple[str, int]]]:
    """Paths of all scans below a folder, sorted, and how many files of other kinds there are by suffix.

    Hidden files and folders are not looked at.

    Raises:
        ValueError: if there is no such folder, or no scan in it.
        OSError: if a folder in it cannot be read.
    """
    if not os.path.isdir(root):
        raise ValueError(f"{root}: not a folder; --root must name the folder of the scans")
    scans, others = [], Counter()
    for path in files_below(Path(root)):
        if path.suffix.lower() in SUFFIXES:
            scans.append(path.relative_to(root).as_posix())
        else:
            others[path.suffix.lower()] += 1
    if not scans:
        raise ValueError(f"{root}: no scan found, no file in it is one of {', '.join(SUFFIXES)}")
    return scans, sorted(others.items())


def object_of(scan: str) -> str:
    """Id of the object that a scan is of: the first folder of its path, or the scan itself."""
    return scan.split("/", 1)[0]


def split_objects(
    objects: dict[str, list[str]], train: int | None, test: int | None
) -> tuple[dict[str, tuple[str, ...]], dict[str, Scans], str]:
    """Objects and scans of each split, and what the split is by.

    The first objects train and the next ones test. Of a single object every fifth scan tests (of fewer than five the
    last), unless the numbers put all into one split.

    Raises:
        ValueError: if there are too few objects or scans.
    """
    if train is None and test is None and len(objects) == 1:
        ((name, scans),) = objects.items()
        if len(scans) < 2:
            raise ValueError("there is one scan only; a category is learnt from many, in different joint states")
        tested = scans[TEST_SHARE - 1 :: TEST_SHARE] or scans[-1:]
        by_split = {"train": [scan for scan in scans if scan not in tested], "test": tested}
        return dict.fromkeys(SPLITS, (name,)), {s: tuple((x, 0) for x in by_split[s]) for s in SPLITS}, "scan"
    if test is None:
        test = max(1, round(len(objects) / TEST_SHARE)) if train is None else len(objects) - train
    if train is None:
        train = len(objects) - test
    if min(train, test) < 0 or not 0 < train + test <= len(objects):
        raise ValueError(
            f"there are {len(objects)} objects (folders below the root, or scans directly in it), too few to split "
            f"into {train} for training and {test} for test; pass other --train-instances and --test-instances"
        )
    names = list(objects)
    instances = {"train": tuple(names[:train]), "test": tuple(names[train : train + test])}
    scans = {
        split: tuple((scan, index) for index, name in enumerate(instances[split]) for scan in objects[name])
        for split in SPLITS
    }
    return instances, scans, "instance"


def _note_lines(readings: dict[str, ScanReading]) -> list[str]:
    """One line for every different note, with the first scans that it is about."""
    about: dict[str, list[str]] = {}
    for scan, reading in readings.items():
        for note in reading.notes:
            about.setdefault(note, []).append(scan)
    named = {note: ", ".join(scans[:_NAMED]) + (", …" if len(scans) > _NAMED else "") for note, scans in about.items()}
    return [f"{len(about[note])} scan(s): {note}: {names}" for note, names in named.items()]


def _scales(
    options: ScanSetOptions, objects: dict[str, list[str]], readings: dict[str, ScanReading]
) -> tuple[dict[str, float], list[str]]:
    """Scale of every scan, and lines about objects whose scans are in different units."""
    scales, lines = {}, []
    for name, scans in objects.items():
        sizes = [readings[scan].size for scan in scans]
        one_unit = max(sizes) <= _SAME_UNIT * min(sizes)
        if options.normalise == "object" and not one_unit:
            lines.append(
                f"{name}: its scans are {min(sizes):.3g} to {max(sizes):.3g} large, which is not one unit; each is "
                "scaled by its own size"
            )
        by_object = options.normalise == "object" and one_unit
        for scan, size in zip(scans, sizes, strict=True):
            own = float(np.median(sizes)) if by_object else size
            scales[scan] = 1.0 if options.normalise == "none" else own
    return scales, lines
