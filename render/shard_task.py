"""The unit of work of the generator: one shard, a function of the options and the shard's place in the set alone."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from math import radians
from pathlib import Path

import numpy as np

from articulate_ssl.geometry.screw import PRISMATIC
from datamodules.shards import SHARD_ARRAYS, write_shard
from render.articulated_object import ArticulatedObject
from render.category import CategorySpec, load_category, parse_category
from render.complete_cloud import ReachableSurface
from render.partial_cloud import DepthSensor
from render.posing import pose_labels, sample_rotation, sample_states
from render.seeds import generator_for
from render.sources import Source, open_source

SAMPLES_PER_SHARD = 250
_REACH_STATES = 8  # in which a sensor looks at an object first; parts must hide each other in different ways


@dataclass(frozen=True)
class SetOptions:
    """Everything that decides the bytes of a data set.

    Attributes:
        category: Name of the category.
        source: One of `render.sources.SOURCES`.
        root: Folder of an external source's data set.
        view: `complete` or `partial`.
        protocol: `honest` or `eap` for partial views, None for complete clouds.
        seed: Of everything random.
        train_instances: Number of training instances.
        test_instances: Number of test instances.
        states: Articulation states per instance.
        rotations: Stored rotations of each complete test cloud; complete training clouds are stored once, unrotated.
        views: Depth views of each articulation state.
        resolution: Width and height of the depth images, pixels.
        points: Points per cloud.
        noise_std: Standard deviation of the depth noise, in units of the rest-state bounding-box diagonal.
        renderer: One of `render.partial_cloud.RENDERERS` for partial views, None for complete clouds.
        variant: Of the category's procedural designs; None for the category itself.
        specification: YAML of a user's own category; None for a built-in one.
        range_deg: Lowest and highest state of hinges, degrees, in place of the category's; None for those.
    """

    category: str
    source: str
    root: str | None
    view: str
    protocol: str | None
    seed: int
    train_instances: int
    test_instances: int
    states: int
    rotations: int
    views: int
    resolution: int
    points: int
    noise_std: float
    renderer: str | None
    variant: str | None = None
    specification: str | None = None
    range_deg: tuple[float, float] | None = None

    @property
    def spec(self) -> CategorySpec:
        """The category."""
        if self.specification is None:
            spec = load_category(self.category, self.variant)
        else:
            spec = parse_category(self.category, self.specification, self.variant)
        return spec if self.range_deg is None else spec.with_hinges_within(*map(radians, self.range_deg))

    def open(self) -> Source:
        """Where the objects come from.

        Raises:
            ValueError: see `render.sources.open_source`.
        """
        return open_source(self.source, self.spec, None if self.root is None else Path(self.root), self.seed)

    def copies(self, split: str) -> int:
        """Stored samples per articulation state."""
        if self.view == "partial":
            return self.views
        return self.rotations if split == "test" else 1

    def recorded(self) -> dict:
        """The options as the manifest records them; of `root` only the folder name, wherever it lies."""
        return asdict(self) | {"root": None if self.root is None else Path(self.root).resolve().name}


@dataclass(frozen=True)
class ShardTask:
    """One shard: states `first_state` to `last_state` (exclusive) of one instance."""

    options: SetOptions
    folder: str
    split: str
    name: str
    instance_index: int
    instance_id: str
    first_state: int
    last_state: int

    def make(self) -> ShardResult:
        """See `make_shard`."""
        return make_shard(self)


@dataclass(frozen=True)
class ShardResult:
    """What the manifest needs to know about a finished shard and its instance; the latter only of posed objects.

    Attributes:
        part_names: K names.
        joint_types: J types.
        rest_state: J joint coordinates at rest; radians, or length in the units of the source.
        articulation_range: J pairs (lower, upper) relative to rest; radians, or length / rest-state diagonal.
        rejected_views: Views drawn again because a part showed too few points.
    """

    split: str
    name: str
    samples: int
    sha256: str
    instance_id: str = ""
    part_names: tuple[str, ...] = ()
    joint_types: tuple[int, ...] = ()
    rest_state: tuple[float, ...] = ()
    articulation_range: tuple[tuple[float, float], ...] = ()
    rejected_views: int = 0


def plan_shards(options: SetOptions, folder: Path, split: str, instance_ids: list[str]) -> list[ShardTask]:
    """The shards of a split in order; independent of how many workers will make them."""
    step = max(1, SAMPLES_PER_SHARD // options.copies(split))
    places = [
        (index, instance_id, first)
        for index, instance_id in enumerate(instance_ids)
        for first in range(0, options.states, step)
    ]
    return [
        ShardTask(
            options=options,
            folder=str(folder),
            split=split,
            name=f"shard-{number:05d}.npz",
            instance_index=index,
            instance_id=instance_id,
            first_state=first,
            last_state=min(first + step, options.states),
        )
        for number, (index, instance_id, first) in enumerate(places)
    ]


def make_shard(task: ShardTask) -> ShardResult:
    """Generate and write one shard.

    Raises:
        ValueError: if the instance is unsound or cannot be sampled.
        OSError: if the shard cannot be written.
    """
    options = task.options
    instance = load_instance(options, task.instance_id)
    ranges = options.spec.sampled_ranges(instance)
    all_states = sample_states(ranges, options.states, _generator(task, "states"))
    make_samples = _partial_samples if options.view == "partial" else _complete_samples
    samples = []
    for state in range(task.first_state, task.last_state):
        samples += make_samples(task, instance, all_states[state], state)
    arrays = _stack(samples, instance, task.instance_index)
    path = Path(task.folder) / task.split / task.name
    path.parent.mkdir(parents=True, exist_ok=True)
    rest = np.array([joint.rest for joint in instance.joints])
    prismatic = np.array([joint.type == PRISMATIC for joint in instance.joints])
    unit = np.where(prismatic, instance.rest_diagonal, 1.0)
    return ShardResult(
        split=task.split,
        name=task.name,
        samples=len(samples),
        sha256=write_shard(path, arrays),
        instance_id=task.instance_id,
        part_names=instance.part_names,
        joint_types=tuple(joint.type for joint in instance.joints),
        rest_state=tuple(rest.tolist()),
        articulation_range=tuple(map(tuple, ((np.array(ranges) - rest[:, None]) / unit[:, None]).tolist())),
        rejected_views=sum(sample.pop("rejected_views", 0) for sample in samples),
    )


@dataclass(frozen=True)
class Reading:
    """What came of reading one object, or scan.

    Attributes:
        name: Its id.
        problem: Why it cannot be used, naming its file; empty if it can.
        checksum: SHA-256 of what was read; empty if it cannot be used.
    """

    name: str
    problem: str = ""
    checksum: str = ""


@dataclass(frozen=True)
class ObjectCheck:
    """Read an object and try to sample it, before any shard is made."""

    options: SetOptions
    instance_id: str

    def make(self) -> Reading:
        """Whether shards can be made of it."""
        load_instance.cache_clear()  # a process that lives on may remember what the files said before
        try:
            instance = load_instance(self.options, self.instance_id)
            if self.options.view == "complete":
                _reachable_surface(self.options, "check", self.instance_id)
            else:
                rng = generator_for(self.options.seed, "check", self.instance_id)
                sensor = _depth_sensor(self.options, self.instance_id)
                for state in sample_states(self.options.spec.sampled_ranges(instance), _REACH_STATES, rng):
                    sensor.observe(instance.part_motion(state), rng)
        except (ValueError, OSError) as error:
            return Reading(self.instance_id, str(error))
        return Reading(self.instance_id, checksum=instance.checksum())


def _generator(task: ShardTask, *key: str | int) -> np.random.Generator:
    return generator_for(task.options.seed, task.split, task.instance_id, *key)


def _complete_samples(
    task: ShardTask, instance: ArticulatedObject, states: np.ndarray, index: int
) -> list[dict[str, np.ndarray]]:
    """One cloud of the articulation state, in one stored orientation (train) or in several (test)."""
    options = task.options
    surface = _reachable_surface(options, task.split, task.instance_id)
    motion = instance.part_motion(states)
    cloud, part_id = surface.cloud(motion, options.points, _generator(task, "cloud", index))
    samples = []
    for copy in range(options.copies(task.split)):
        rotation = np.eye(3) if task.split == "train" else sample_rotation(_generator(task, "rotation", index, copy))
        rotated = np.einsum("nb,ab->na", cloud, rotation)
        center, scale = rotated.mean(0), instance.rest_diagonal
        labels = pose_labels(instance, states, motion, rotation, np.zeros(3), center, scale)
        samples.append({"points": (rotated - center) / scale, "part_id": part_id, **labels})
    return samples


def _partial_samples(
    task: ShardTask, instance: ArticulatedObject, states: np.ndarray, index: int
) -> list[dict[str, np.ndarray]]:
    """Several views of the articulation state."""
    sensor = _depth_sensor(task.options, task.instance_id)
    motion = instance.part_motion(states)
    samples = []
    for view in range(task.options.views):
        seen = sensor.observe(motion, _generator(task, "view", index, view))
        labels = pose_labels(instance, states, motion, seen.rotation, seen.translation, seen.center, seen.scale)
        points = (seen.points - seen.center) / seen.scale
        samples.append({"points": points, "part_id": seen.part_id, "rejected_views": seen.rejected_views, **labels})
    return samples


def _stack(samples: list[dict[str, np.ndarray]], instance: ArticulatedObject, index: int) -> dict[str, np.ndarray]:
    """The arrays of a shard, with their dtypes."""
    constant = {
        "instance": index,
        "joint_parent": [joint.parent for joint in instance.joints],
        "joint_child": [joint.child for joint in instance.joints],
        "joint_type": [joint.type for joint in instance.joints],
    }
    arrays = {}
    for name, spec in SHARD_ARRAYS.items():
        values = [constant[name]] * len(samples) if name in constant else [sample[name] for sample in samples]
        arrays[name] = np.array(values, dtype=spec.dtype)
    return arrays


@lru_cache(maxsize=1)
def load_instance(options: SetOptions, instance_id: str) -> ArticulatedObject:
    """The validated instance in its category's rest state; kept for the next shard of the same instance."""
    return options.spec.to_rest(options.open().load(instance_id).validate())


@lru_cache(maxsize=1)
def _reachable_surface(options: SetOptions, split: str, instance_id: str) -> ReachableSurface:
    """The instance's pool of reachable points; kept for the next shard of the same instance."""
    instance = load_instance(options, instance_id)
    rng = generator_for(options.seed, split, instance_id, "surface")
    states = sample_states(options.spec.sampled_ranges(instance), _REACH_STATES, rng)
    return ReachableSurface(instance, states, rng)


@lru_cache(maxsize=1)
def _depth_sensor(options: SetOptions, instance_id: str) -> DepthSensor:
    """The sensor that looks at the instance; kept for the next shard of the same instance."""
    spec = options.spec
    return DepthSensor(
        load_instance(options, instance_id),
        spec.view,
        renderer=options.renderer,
        protocol=options.protocol,
        resolution=options.resolution,
        num_points=options.points,
        min_visible_points=spec.min_visible_points,
        noise_std=options.noise_std,
    )
