"""A tiny data set with known geometry: two-part boxes on a hinge, or with a drawer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import roma
import torch

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from datamodules.manifest import Manifest, ShardEntry, set_folder
from datamodules.shards import write_shard

RANGE = {REVOLUTE: (0.2, 1.5), PRISMATIC: (0.05, 0.4)}


def synthetic_arrays(
    instances: list[tuple[int, np.ndarray]],  # per instance: its index and its box size [3]
    states: int,
    rotations: int,
    points: int,
    rotate: bool,
    rng: np.random.Generator,
    joint_type: int = REVOLUTE,
) -> dict[str, np.ndarray]:
    """Shard arrays of a base plate (part 0) and a lid hinged at its rear edge (part 1), instance by instance."""
    samples = []
    for index, size in instances:
        low = np.array([[0, 0, 0], [0, 0, 1.1 * size[2]]])
        high = np.array([size, [size[0], size[1], 1.4 * size[2]]])
        scale = np.linalg.norm(high.max(0) - low.min(0))
        axis = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
        pivot = torch.tensor(np.array([[0.0, 0.0, 1.1 * size[2]]]) / scale)
        for state in rng.uniform(*RANGE[joint_type], size=states):
            motion = screw_motion(axis, pivot, torch.tensor([state], dtype=torch.float64), joint_type)
            part_motion = forward_kinematics(motion, [0], [1], 2)
            part_id = np.sort(rng.permutation(points) % 2).astype(np.uint8)
            rng.shuffle(part_id)
            rest = rng.uniform(low[part_id], high[part_id]) / scale
            posed = transform_points(part_motion[part_id.astype(np.int64)], torch.from_numpy(rest)[:, None])[:, 0]
            center = posed.mean(0)
            for _ in range(rotations):
                rotation = torch.eye(3, dtype=torch.float64)
                if rotate:
                    rotation = roma.unitquat_to_rotmat(
                        torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=4)), dim=0)
                    )
                pose = se3(rotation, -rotation @ center)
                samples.append(
                    {
                        "points": transform_points(pose, posed),
                        "part_id": part_id,
                        "part_pose": pose @ part_motion,
                        "part_center": (low + high) / 2 / scale,
                        "joint_axis": axis @ rotation.mT,
                        "joint_pivot": transform_points(pose, pivot),
                        "joint_state": [state],
                        "joint_parent": [0],
                        "joint_child": [1],
                        "joint_type": [joint_type],
                        "instance": index,
                        "object_rotation": rotation,
                        "center": rotation @ center * scale,
                        "scale": scale,
                    }
                )
    dtypes = {
        "part_id": np.uint8,
        "joint_parent": np.int8,
        "joint_child": np.int8,
        "joint_type": np.uint8,
        "instance": np.int32,
    }
    return {
        name: np.stack([np.asarray(sample[name], dtypes.get(name, np.float32)) for sample in samples])
        for name in samples[0]
    }


def write_synthetic_set(
    root: str | Path,
    category: str = "laptop",
    view: str = "complete",
    protocol: str | None = None,
    train_instances: int = 3,
    test_instances: int = 2,
    states: int = 4,
    rotations: int = 2,
    points: int = 128,
    joint_type: int = REVOLUTE,
    seed: int = 0,
) -> Path:
    """Write a complete data set under `root`, one shard per instance, and return its folder.

    Training clouds of the complete view are stored once per state, unrotated; all others under `rotations` rotations.
    """
    rng = np.random.default_rng(seed)
    folder = set_folder(root, category, "procedural", view, protocol)
    ids, shards = {}, {}
    for split, count in (("train", train_instances), ("test", test_instances)):
        (folder / split).mkdir(parents=True)
        ids[split] = tuple(f"{split}-{i}" for i in range(count))
        entries = []
        rotate = split == "test" or view == "partial"
        for i in range(count):
            instance = [(i, rng.uniform([0.5, 0.5, 0.1], [1.0, 1.0, 0.3]))]
            arrays = synthetic_arrays(instance, states, rotations if rotate else 1, points, rotate, rng, joint_type)
            name = f"shard-{i:05d}.npz"
            sha256 = write_shard(folder / split / name, arrays)
            entries.append(ShardEntry(name, len(arrays["scale"]), sha256))
        shards[split] = tuple(entries)
    Manifest(
        generator_version="test",
        options={"states": states, "rotations": rotations, "points": points},
        seed=seed,
        category=category,
        source="procedural",
        view=view,
        protocol=protocol,
        part_names=("base", "lid"),
        joint_types=(joint_type,),
        articulation_range=(RANGE[joint_type],),
        instances=ids,
        rest_state={instance: (0.0,) for split in ids.values() for instance in split},
        shards=shards,
    ).save(folder)
    return folder
