"""Occupancy samples of posed objects, for methods that learn implicit functions: points, and which of them are inside.

Where points lie follows IM-NET (Chen and Zhang 2019), whose way BAE-Net and BSP-Net share: near the surface, and
anywhere around the shape. What is inside follows it, too: its shapes are voxels that a surface touches or encloses, so
a plate without thickness is as thick as a voxel. Here, a point is inside the object if a part encloses it (generalised
winding number above one half; Jacobson et al. 2013) or has a surface nearer than half a voxel. So open shells of CAD
models have an inside, too: their walls, but not what they fail to enclose. Procedural objects are closed solids.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh

from datamodules.manifest import Manifest
from datamodules.occupancy import (
    FOLDER,
    INDEX_NAME,
    OccupancyEntry,
    OccupancyError,
    OccupancyIndex,
    samples_path,
    write_samples,
)
from datamodules.shards import read_shard, sha256_of
from render.articulated_object import ArticulatedObject
from render.complete_cloud import fibonacci_sphere, move_parts, sample_surface
from render.execution import run_tasks
from render.object_set import ObjectSet
from render.posing import sample_rotation
from render.progress import with_progress
from render.seeds import generator_for
from render.shard_task import ShardTask, load_instance

# Methods learn from training clouds; nobody trains on the others.
SPLIT = "train"
# IM-NET's finest grid has 64 voxels along an object.
VOXEL = 1 / 64
# Of the points near the surface, in rest-state diagonals: two voxels. Chosen without a measurement.
NEAR_STD = 2 * VOXEL
# The other points fill the ball around the object, this much larger.
BALL = 1.1
# Directions along which crossings are counted. For a closed surface every one gives the winding number, except where it
# meets an edge; for an open one it is their mean.
_CLOSED_DIRECTIONS, _OPEN_DIRECTIONS = 3, 32


class SolidPart:
    """One part's mesh, ready to be asked what lies in it."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._bounds = mesh.bounds
        self._normals = np.asarray(mesh.face_normals)
        directions = fibonacci_sphere(_CLOSED_DIRECTIONS if mesh.is_watertight else _OPEN_DIRECTIONS)
        # Turned away from the axes, along which the edges of made objects run.
        turned = np.einsum("na,ba->nb", directions, sample_rotation(np.random.default_rng(0)))
        self._directions = turned.astype(np.float32)
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))

    def contains(
        self,
        points: np.ndarray,  # [N, 3]
        margin: float,
    ) -> np.ndarray:  # [N] bool
        """Which points are enclosed, or nearer to the surface than `margin`, in the mesh's frame and unit."""
        inside = np.zeros(len(points), dtype=bool)
        around = ((points > self._bounds[0] - margin) & (points < self._bounds[1] + margin)).all(1)
        candidates = np.flatnonzero(around)
        if margin > 0 and len(candidates):
            query = points[candidates].astype(np.float32)
            inside[candidates] = self._scene.compute_distance(query, nthreads=1).numpy() < margin
            candidates = candidates[~inside[candidates]]
        if len(candidates):
            inside[candidates] = self.winding_number(points[candidates]) > 0.5
        return inside

    def winding_number(
        self,
        points: np.ndarray,  # [N, 3]
    ) -> np.ndarray:  # [N]
        """Crossings outwards less crossings inwards, of the mean (closed meshes: median) direction."""
        crossings = []
        for direction in self._directions:
            rays = np.concatenate([points, np.broadcast_to(direction, points.shape)], axis=1, dtype=np.float32)
            hits = self._scene.list_intersections(rays, nthreads=1)
            sign = np.sign(self._normals[hits["primitive_ids"].numpy()] @ direction)
            crossings.append(np.bincount(hits["ray_ids"].numpy(), weights=sign, minlength=len(points)))
        reduce = np.median if len(crossings) == _CLOSED_DIRECTIONS else np.mean
        return reduce(crossings, axis=0)


def sample_occupancy(
    instance: ArticulatedObject,
    solids: list[SolidPart],  # K, of the instance's meshes
    part_pose: np.ndarray,  # [K, 4, 4] object frame / scale -> cloud, as in a shard
    scale: float,
    count: int,
    rng: np.random.Generator,
    voxel: float = VOXEL,
) -> tuple[np.ndarray, np.ndarray]:  # [count, 3] float16 and [count] bool
    """Points around a posed instance, the first half near its surface, and which of them are inside; in cloud units."""
    motion = part_pose.astype(np.float64).copy()
    motion[:, :3, :3] /= scale
    surface, part_id = sample_surface(instance, count, rng)
    surface = move_parts(surface, part_id, motion)
    center = (surface.min(0) + surface.max(0)) / 2
    radius = BALL * np.linalg.norm(surface - center, axis=1).max()
    unit = instance.rest_diagonal / scale  # a rest-state diagonal in the units of the cloud
    near = count // 2
    points = np.empty((count, 3))
    points[:near] = surface[:near] + rng.normal(0.0, NEAR_STD * unit, (near, 3))
    direction = rng.normal(size=(count - near, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points[near:] = center + radius * np.cbrt(rng.random((count - near, 1))) * direction
    points = points.astype(np.float16)  # what is stored is what is asked about
    inside = np.zeros(count, dtype=bool)
    for solid, matrix in zip(solids, motion, strict=True):
        outside = np.flatnonzero(~inside)
        back = np.linalg.inv(matrix)
        at_rest = np.einsum("ab,nb->na", back[:3, :3], points[outside].astype(np.float64)) + back[:3, 3]
        inside[outside] = solid.contains(at_rest, voxel / 2 * instance.rest_diagonal)
    return points, inside


@dataclass(frozen=True)
class OccupancyTask:
    """The occupancy samples of one shard."""

    shard: ShardTask
    shard_sha256: str
    points: int

    def make(self) -> OccupancyEntry:
        """Draw and write them."""
        task = self.shard
        arrays = read_shard(Path(task.folder) / task.split / task.name)
        instance = load_instance(task.options, task.instance_id)
        solids = [SolidPart(mesh) for mesh in instance.meshes]
        points = np.empty((len(arrays["scale"]), self.points, 3), dtype=np.float16)
        inside = np.empty(points.shape[:2], dtype=bool)
        for row, (pose, scale) in enumerate(zip(arrays["part_pose"], arrays["scale"].tolist(), strict=True)):
            rng = generator_for(task.options.seed, task.split, task.instance_id, "occupancy", task.first_state, row)
            points[row], inside[row] = sample_occupancy(instance, solids, pose, scale, self.points, rng)
        path = samples_path(task.folder, task.split, task.name)
        return OccupancyEntry(task.split, task.name, self.shard_sha256, write_samples(path, points, inside))


def write_occupancy(
    plan: ObjectSet,
    folder: Path,
    points: int,
    workers: int,
    scheduler: str | None = None,
) -> OccupancyIndex:
    """Give a finished set of posed objects occupancy samples of its training clouds; what it has already stays.

    Args:
        plan: What the set was made of.
        folder: Of the set.
        points: Samples of every cloud.
        workers: Processes.
        scheduler: See `render.execution.run_tasks`.

    Raises:
        ValueError: if an instance is unsound or cannot be read.
        OSError: if the output cannot be written.
    """
    shards = {entry.name: entry for entry in Manifest.load(folder).shards[SPLIT]}
    found = _found(folder, points)
    tasks, done = [], []
    for task in (task for task in plan.tasks(folder) if task.split == SPLIT):
        entry = None if found is None else found.find(SPLIT, shards[task.name])
        path = samples_path(folder, SPLIT, task.name)
        if entry is not None and path.is_file() and sha256_of(path) == entry.sha256:
            done.append(entry)
        else:
            tasks.append(OccupancyTask(task, shards[task.name].sha256, points))
    if not tasks and found is not None:
        return found
    (folder / FOLDER / INDEX_NAME).unlink(missing_ok=True)
    done += with_progress(run_tasks(tasks, workers, scheduler), len(tasks), f"{plan.options.category} occupancy")
    index = OccupancyIndex(points, VOXEL, tuple(sorted(done, key=lambda entry: entry.shard)))
    index.save(folder)
    return index


def _found(folder: Path, points: int) -> OccupancyIndex | None:
    """What is there already, if it is sound and of this kind."""
    try:
        index = OccupancyIndex.load(folder)
    except OccupancyError:
        return None
    return index if (index.points, index.voxel) == (points, VOXEL) else None
