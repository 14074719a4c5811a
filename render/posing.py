"""Which articulation states and global rotations of an instance become samples, and the labels that follow."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from render.articulated_object import ArticulatedObject


def sample_states(
    ranges: list[tuple[float, float]],
    num_states: int,
    rng: np.random.Generator,
) -> np.ndarray:  # [num_states, J]
    """Articulation states by Latin hypercube sampling: every joint alone covers its range [lower, upper) evenly."""
    lower, upper = np.array(ranges).reshape(-1, 2).T
    strata = np.array([rng.permutation(num_states) for _ in ranges]).reshape(-1, num_states).T  # [num_states, J]
    share = (strata + rng.random(strata.shape)) / num_states
    return lower + share * (upper - lower)


def sample_rotation(rng: np.random.Generator) -> np.ndarray:  # [3, 3]
    """A rotation uniform on SO(3)."""
    return Rotation.random(rng=rng).as_matrix()


def compose(
    rotation: np.ndarray,  # [3, 3]
    translation: np.ndarray,  # [3]
    motion: np.ndarray,  # [K, 4, 4]
) -> np.ndarray:  # [K, 4, 4]
    """Poses of parts that move in the object frame, then with the whole object."""
    pose = motion.copy()
    # einsum, not a matrix product: BLAS may round differently with the number of threads.
    pose[:, :3] = np.einsum("ab,kbc->kac", rotation, motion[:, :3])
    pose[:, :3, 3] += translation
    return pose


def pose_labels(
    instance: ArticulatedObject,
    states: np.ndarray,  # [J]
    motion: np.ndarray,  # [K, 4, 4], `instance.part_motion(states)`
    rotation: np.ndarray,  # [3, 3]
    translation: np.ndarray,  # [3], so that camera = rotation @ object + translation
    center: np.ndarray,  # [3], camera frame
    scale: float,
) -> dict[str, np.ndarray]:
    """The pose and joint arrays of one sample of a shard, named and defined as in `datamodules.shards` (float64)."""
    pose = compose(rotation, translation - center, motion)
    pose[:, :3, 3] /= scale
    parent = [joint.parent for joint in instance.joints]
    axis = np.array([joint.axis for joint in instance.joints]).reshape(-1, 3)
    pivot = np.array([joint.pivot for joint in instance.joints]).reshape(-1, 3) / scale
    prismatic = np.array([joint.type for joint in instance.joints], dtype=bool)
    return {
        "part_pose": pose,
        "joint_axis": np.einsum("jab,jb->ja", pose[parent, :3, :3], axis),
        "joint_pivot": np.einsum("jab,jb->ja", pose[parent, :3, :3], pivot) + pose[parent, :3, 3],
        "joint_state": np.where(prismatic, states / scale, states),
        "part_center": instance.part_centers / scale,
        "object_rotation": rotation,
        "center": center,
        "scale": np.float64(scale),
    }
