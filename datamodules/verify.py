"""Re-check a generated data set from first principles: `python -m datamodules.verify DIR`.

Checks every shard's checksum, arrays and labels, reports every problem with the file it is in, and never stops at the
first. Exit code 0 if the set is sound, 2 if not.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from datamodules.manifest import SPLITS, Manifest, ManifestError
from datamodules.occupancy import FOLDER, REMEDY, OccupancyError, OccupancyIndex, open_samples, samples_path
from datamodules.shards import ShardError, read_shard, sha256_of

TOLERANCE = 1e-4  # a few hundred float32 roundings of values of size 1

Arrays = Mapping[str, np.ndarray]


def verify_set(
    folder: str | os.PathLike,
    progress: Callable[[Sequence], Iterator] = iter,
) -> list[str]:
    """Every problem of a data set, each a line that begins with the file it is in; empty if the set is sound.

    Args:
        folder: Data set folder, the one that holds `manifest.json`.
        progress: Wraps the loop over the shards, for example `rich.progress.track`.
    """
    folder = Path(folder)
    try:
        manifest = Manifest.load(folder)
    except ManifestError as error:
        return [str(error)]
    problems, shards = [], []
    for split in SPLITS:
        listed = {entry.name for entry in manifest.shards[split]}
        stray = sorted(path for path in (folder / split).glob("*.npz") if path.name not in listed)
        problems += [f"{path}: not in the manifest" for path in stray]
        if manifest.instances[split] and not listed:
            problems.append(f"{folder / split}: the split has no shards")
        shards += [(split, entry) for entry in manifest.shards[split]]
    for split, entry in progress(shards):
        path = folder / split / entry.name
        try:
            arrays = read_shard(path, entry.sha256)
        except (ShardError, OSError) as error:
            problems.append(str(error))
            continue
        if len(arrays["scale"]) != entry.samples:
            problems.append(f"{path}: has {len(arrays['scale'])} samples, the manifest says {entry.samples}")
        problems += [f"{path}: {problem}" for problem in label_problems(arrays, manifest, split)]
    return problems + list(occupancy_problems(folder, manifest))


def occupancy_problems(folder: Path, manifest: Manifest) -> Iterator[str]:
    """What is wrong with a set's occupancy samples; a set need not have any."""
    if not (folder / FOLDER).exists():
        return
    try:
        index = OccupancyIndex.load(folder)
    except OccupancyError as error:
        yield str(error)
        return
    shards = {(split, shard.name): shard for split in SPLITS for shard in manifest.shards[split]}
    for entry in index.entries:
        path, shard = samples_path(folder, entry.split, entry.shard), shards.get((entry.split, entry.shard))
        if shard is None or shard.sha256 != entry.shard_sha256:
            yield f"{path}: {entry.split} shard {entry.shard} is not the one that these samples were drawn for"
            continue
        try:
            open_samples(path, shard.samples, index.points)
        except OccupancyError as error:
            yield str(error)
            continue
        if sha256_of(path) != entry.sha256:
            yield f"{path}: is damaged, its SHA-256 is not that of the index. {REMEDY}"


def label_problems(arrays: Arrays, manifest: Manifest, split: str) -> Iterator[str]:
    """What is wrong with the values of one shard's arrays. Each problem names the first sample that has it."""
    if ("part_id" in arrays) != manifest.labelled:
        yield f"has {'no labels' if manifest.labelled else 'labels'}, the manifest says otherwise"
        return
    if not manifest.labelled:
        for problem, bad in (*_instance_check(arrays, manifest, split), *_value_checks(arrays)):
            if bad.any():
                yield _describe(problem, bad)
        return
    found, expected = (
        (arrays["part_pose"].shape[1], arrays["joint_type"].shape[1]),
        (manifest.num_parts, len(manifest.joint_types)),
    )
    if found != expected:
        yield "has {} parts and {} joints, the manifest says {} and {}".format(*found, *expected)
        return
    indices_sound = True
    for problem, bad in (*_instance_check(arrays, manifest, split), *_index_checks(arrays, manifest)):
        if bad.any():
            indices_sound = False
            yield _describe(problem, bad)
    for problem, bad in _value_checks(arrays):
        if bad.any():
            yield _describe(problem, bad)
    # Motions can be compared only where the indices that name parts and instances can be trusted.
    if indices_sound:
        for problem, bad in _motion_checks(arrays, manifest, split):
            if bad.any():
                yield _describe(problem, bad)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m datamodules.verify", description=__doc__.splitlines()[0])
    parser.add_argument("folder", metavar="DIR", type=Path, help="data set folder, the one that holds manifest.json")
    folder = parser.parse_args(arguments).folder
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    problems = verify_set(folder, lambda shards: track(shards, "Verifying", console=console, transient=True))
    for problem in problems:
        console.print(problem, markup=False)
    if problems:
        console.print(f"{folder}: {len(problems)} problem(s)", markup=False)
        return 2
    manifest = Manifest.load(folder)
    counts = ", ".join(f"{manifest.num_samples(s)} {s} samples in {len(manifest.shards[s])} shards" for s in SPLITS)
    Console(soft_wrap=True, highlight=False).print(f"{folder}: sound; {counts}", markup=False)
    return 0


def _describe(problem: str, bad: np.ndarray) -> str:
    """`bad` is a [S, ...] mask."""
    samples = np.flatnonzero(bad.reshape(len(bad), -1).any(1))
    return f"{problem} (sample {samples[0]} and {len(samples) - 1} more of {len(bad)})"


def _instance_check(arrays: Arrays, manifest: Manifest, split: str) -> Iterator[tuple[str, np.ndarray]]:
    """Like `_index_checks`, of what every set has."""
    instances = len(manifest.instances[split])
    yield f"instance is outside 0..{instances - 1}", (arrays["instance"] < 0) | (arrays["instance"] >= instances)


def _index_checks(arrays: Arrays, manifest: Manifest) -> Iterator[tuple[str, np.ndarray]]:
    """Checks of the integer labels: pairs of a problem and the [S, ...] mask of where it occurs."""
    num_parts = manifest.num_parts
    part_id, parent, child = arrays["part_id"], arrays["joint_parent"], arrays["joint_child"]
    yield f"part_id is outside 0..{num_parts - 1}", part_id >= num_parts
    for part, name in enumerate(manifest.part_names):
        yield f"no point belongs to part {name!r}", ~(part_id == part).any(1)
    for name, index in (("joint_parent", parent), ("joint_child", child)):
        yield f"{name} is outside 0..{num_parts - 1}", (index < 0) | (index >= num_parts)
    yield "joint_type differs from the manifest's", arrays["joint_type"] != np.array(manifest.joint_types, np.uint8)
    trees, tree_of = np.unique(np.stack([parent, child], 1), axis=0, return_inverse=True)
    unsound = np.array([not _is_forest(tree[0].tolist(), tree[1].tolist(), num_parts) for tree in trees])
    yield "the joints form no tree", unsound[tree_of.reshape(-1)]


def _is_forest(parent: list[int], child: list[int], num_parts: int) -> bool:
    try:
        forward_kinematics(torch.eye(4).expand(len(child), 4, 4), parent, child, num_parts)
    except ValueError:
        return False
    return True


def _value_checks(arrays: Arrays) -> Iterator[tuple[str, np.ndarray]]:
    """Checks of single floating-point arrays."""
    for name, array in arrays.items():
        if array.dtype.kind == "f":
            yield f"{name} has NaN or infinite values", ~np.isfinite(array)
    yield "scale is not positive", arrays["scale"] <= 0
    if "part_pose" not in arrays:
        return
    yield "joint_axis is not of unit length", _exceeds(np.linalg.norm(arrays["joint_axis"], axis=-1) - 1)
    for name in ("object_rotation", "part_pose"):
        rotation = arrays[name][..., :3, :3].astype(np.float64)
        yield f"{name} is not a rotation", _exceeds(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3))
        yield f"{name} mirrors", np.linalg.det(np.nan_to_num(rotation)) < 0
    yield "part_pose has a last row other than 0 0 0 1", _exceeds(arrays["part_pose"][..., 3, :] - np.eye(4)[3])


def _motion_checks(arrays: Arrays, manifest: Manifest, split: str) -> Iterator[tuple[str, np.ndarray]]:
    """Checks of part poses against joints, object rotation and points."""
    pose = torch.from_numpy(arrays["part_pose"].astype(np.float64))
    parent, child = (torch.from_numpy(arrays[name].astype(np.int64)) for name in ("joint_parent", "joint_child"))
    axis, pivot = (torch.from_numpy(arrays[name].astype(np.float64)) for name in ("joint_axis", "joint_pivot"))
    rest_by_instance = np.array([manifest.rest_state[i] for i in manifest.instances[split]])
    rest = rest_by_instance[arrays["instance"]]
    sample = torch.arange(len(pose))
    for j, joint_type in enumerate(manifest.joint_types):
        moved = arrays["joint_state"][:, j] - (rest[:, j] if joint_type == REVOLUTE else rest[:, j] / arrays["scale"])
        motion = screw_motion(axis[:, j], pivot[:, j], torch.from_numpy(moved).double(), joint_type)
        lower, upper = manifest.articulation_range[j]
        # In partial views the scale is not the diagonal that a prismatic range is stated in.
        if joint_type == REVOLUTE or manifest.view == "complete":
            outside = (moved < lower - TOLERANCE) | (moved > upper + TOLERANCE)
            yield f"state of joint {j} is outside the articulation range", outside
        expected = motion @ pose[sample, parent[:, j]]
        difference = (expected - pose[sample, child[:, j]]).numpy()
        yield f"part_pose contradicts axis, pivot and state of joint {j}", _exceeds(difference)
    if manifest.view == "complete":
        yield "points are not centred on their mean", _exceeds(arrays["points"].mean(1, dtype=np.float64))
        yield "points at rest reach beyond a box of diagonal 1", _rest_diagonal(arrays) > 1 + TOLERANCE
    is_base = np.ones(arrays["part_pose"].shape[:2], dtype=bool)
    np.put_along_axis(is_base, arrays["joint_child"].astype(np.int64), False, axis=1)
    difference = arrays["part_pose"][..., :3, :3] - arrays["object_rotation"][:, None]
    yield "the base part is not turned by object_rotation", _exceeds(difference) & is_base[..., None, None]


def _rest_diagonal(arrays: Arrays) -> np.ndarray:  # [S]
    """Bounding-box diagonal of the points, every one moved back to the rest state by its part's pose."""
    lower, upper = np.inf, -np.inf
    for part in range(arrays["part_pose"].shape[1]):
        pose = arrays["part_pose"][:, part]
        at_rest = (arrays["points"] - pose[:, None, :3, 3]) @ pose[:, :3, :3]
        belongs = (arrays["part_id"] == part)[..., None]
        lower = np.minimum(lower, np.where(belongs, at_rest, np.inf).min(1))
        upper = np.maximum(upper, np.where(belongs, at_rest, -np.inf).max(1))
    return np.linalg.norm(upper - lower, axis=-1)


def _exceeds(error: np.ndarray) -> np.ndarray:
    """Where an error is above tolerance; NaN counts as above."""
    return ~(np.abs(error) <= TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
