"""Complete clouds: uniform by area over the surface a sensor could reach, then farthest-point sampled."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import trimesh

from render.articulated_object import ArticulatedObject
from render.farthest_point import farthest_point_order

POOL_SIZE = 32768  # reachable candidates per instance
OVERSAMPLING = 2  # candidates per stored point
NUM_DIRECTIONS = 64
_MAX_DRAWS = 16


class ReachableSurface:
    """Points of an instance's surface that a distant sensor sees from some direction in some articulation state.

    Interior faces of CAD meshes and faces buried in other parts are thereby left out.

    Attributes:
        points: [M, 3] in the object frame at rest, uniform by area over the reachable surface.
        part_id: [M] part of every point.
    """

    def __init__(
        self,
        instance: ArticulatedObject,
        states: np.ndarray,  # [V, J] articulation states in which to look
        rng: np.random.Generator,
        pool_size: int = POOL_SIZE,
    ) -> None:
        """Draw the pool.

        Raises:
            ValueError: if hardly any surface can be reached, or none of some part.
        """
        self.instance = instance
        scenes = [_Scene(instance, instance.part_motion(q)) for q in states]
        own = _OwnPart(instance, [scene.motion for scene in scenes])
        drawn_points, drawn_part, reached = [], [], 0
        for _ in range(_MAX_DRAWS):
            points, part_id = sample_surface(instance, pool_size, rng)
            visible = scenes[0].reaches(points, part_id)
            hidden = np.flatnonzero(~visible)
            ways = own.leaves_open(points[hidden], part_id[hidden])
            for scene in scenes[1:]:
                found = scene.reaches(points[hidden], part_id[hidden], ways)
                visible[hidden[found]] = True
                hidden, ways = hidden[~found], ways[:, ~found]
            drawn_points.append(points[visible])
            drawn_part.append(part_id[visible])
            reached += int(visible.sum())
            if reached >= pool_size:
                break
        else:
            raise ValueError(
                f"{instance.category} instance {instance.name!r}: a sensor reaches only {reached} of "
                f"{_MAX_DRAWS * pool_size} surface points; its meshes are nested in each other"
            )
        self.points = np.concatenate(drawn_points)[:pool_size]
        self.part_id = np.concatenate(drawn_part)[:pool_size]
        for part, name in enumerate(instance.part_names):
            if not (self.part_id == part).any():
                raise ValueError(f"{instance.category} instance {instance.name!r}: no sensor reaches part {name!r}")

    def cloud(
        self,
        motion: np.ndarray,  # [K, 4, 4]
        num_points: int,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray]:  # [num_points, 3] and [num_points]
        """A complete cloud of the posed instance and its part ids, in farthest-point order.

        Raises:
            ValueError: if it is of so few points that some part has none, however often it is drawn.
        """
        size = min(OVERSAMPLING * num_points, len(self.points))
        for _ in range(_MAX_DRAWS):
            chosen = rng.choice(len(self.points), size, replace=False, shuffle=False)
            posed = move_parts(self.points[chosen], self.part_id[chosen], motion)
            order = farthest_point_order(posed, num_points)
            part_id = self.part_id[chosen[order]]
            shown = np.bincount(part_id, minlength=self.instance.num_parts)
            if shown.all():
                return posed[order], part_id
        raise ValueError(
            f"{self.instance.category} instance {self.instance.name!r}: part "
            f"{self.instance.part_names[int(shown.argmin())]!r} has none of {num_points} points; pass more --points"
        )


def sample_surface(
    instance: ArticulatedObject, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:  # [count, 3] and [count]
    """Points uniform by area over all part meshes at rest, and their part ids."""
    whole = trimesh.util.concatenate(instance.meshes)
    face_part = np.repeat(np.arange(instance.num_parts), [len(mesh.faces) for mesh in instance.meshes])
    points, faces = trimesh.sample.sample_surface(whole, count, seed=int(rng.integers(2**63)))
    return np.asarray(points), face_part[faces].astype(np.uint8)


def move_parts(
    points: np.ndarray,  # [N, 3]
    part_id: np.ndarray,  # [N]
    motion: np.ndarray,  # [K, 4, 4]
) -> np.ndarray:  # [N, 3]
    """Every point moved with its part."""
    moved = np.empty_like(points)
    for part, matrix in enumerate(motion):
        mine = part_id == part
        # einsum, not a matrix product: BLAS may round differently with the number of threads.
        moved[mine] = np.einsum("ab,nb->na", matrix[:3, :3], points[mine]) + matrix[:3, 3]
    return moved


class _OwnPart:
    """What hides a point in every articulation state: its own part, where that is never turned."""

    def __init__(self, instance: ArticulatedObject, motions: list[np.ndarray]) -> None:
        rotations = np.stack(motions)[:, :, :3, :3]
        self.gap = _gap(instance)
        self.casters = {
            part: _ray_caster([mesh])
            for part, mesh in enumerate(instance.meshes)
            if (rotations[:, part] == np.eye(3)).all()
        }

    def leaves_open(self, points: np.ndarray, part_id: np.ndarray) -> np.ndarray:  # [NUM_DIRECTIONS, N] bool
        """The directions in which a point's own part does not hide it, as far as one state tells that of all."""
        ways = np.ones((NUM_DIRECTIONS, len(points)), dtype=bool)
        for part, caster in self.casters.items():
            mine = np.flatnonzero(part_id == part)
            for way, direction in zip(ways, _directions(), strict=True):
                way[mine] = _free(caster, points[mine].astype(np.float32), direction, self.gap)
        return ways


class _Scene:
    """The posed instance, ready for occlusion tests from distant sensors."""

    def __init__(self, instance: ArticulatedObject, motion: np.ndarray) -> None:
        self.motion = motion
        self.gap = _gap(instance)
        self.caster = _ray_caster(
            [mesh.copy().apply_transform(matrix) for mesh, matrix in zip(instance.meshes, motion, strict=True)]
        )

    def reaches(
        self,
        points: np.ndarray,  # [N, 3]
        part_id: np.ndarray,  # [N]
        ways: np.ndarray | None = None,  # [NUM_DIRECTIONS, N] bool: the directions to look in; all by default
    ) -> np.ndarray:  # [N] bool
        """Whether the line from a point to infinity is free in one of many directions."""
        posed = move_parts(points, part_id, self.motion).astype(np.float32)
        free = np.zeros(len(points), dtype=bool)
        for k, direction in enumerate(_directions()):
            asked = np.flatnonzero(~free if ways is None else ~free & ways[k])
            free[asked] = _free(self.caster, posed[asked], direction, self.gap)
        return free


def fibonacci_sphere(count: int) -> np.ndarray:  # [count, 3]
    """Nearly even unit directions, in an order that alternates between the hemispheres."""
    k = np.arange(count)
    y = 1 - (2 * k + 1) / count
    radius, angle = np.sqrt(1 - y * y), np.pi * (3 - np.sqrt(5)) * k
    directions = np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)
    return directions[np.argsort(np.minimum(k, count - 1 - k) * 2 + (k >= count / 2))]


def _directions() -> np.ndarray:  # [NUM_DIRECTIONS, 3] float32
    return fibonacci_sphere(NUM_DIRECTIONS).astype(np.float32)


def _gap(instance: ArticulatedObject) -> float:
    """How far from its point a ray begins, so that the point's own triangle does not stop it."""
    return 1e-4 * instance.rest_diagonal


def _ray_caster(meshes: list[trimesh.Trimesh]) -> o3d.t.geometry.RaycastingScene:
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in meshes:
        caster.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    return caster


def _free(
    caster: o3d.t.geometry.RaycastingScene,
    points: np.ndarray,  # [N, 3] float32
    direction: np.ndarray,  # [3] float32
    gap: float,
) -> np.ndarray:  # [N] bool
    """Whether nothing lies between the points and infinity."""
    rays = np.empty((len(points), 6), dtype=np.float32)
    rays[:, :3] = points + gap * direction
    rays[:, 3:] = direction
    return ~caster.test_occlusions(rays, nthreads=1).numpy()
