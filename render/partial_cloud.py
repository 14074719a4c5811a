"""Partial clouds: what one depth image of the posed object shows.

Protocols (named in every file and table):
    honest: one scene, so parts hide each other; normalised by what was observed alone.
    eap: each part rendered alone, so parts never hide each other, and normalised by the complete mesh, as in the
        code of the paper; only for comparison with published tables.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from render.articulated_object import ArticulatedObject
from render.camera import BACKGROUND, Camera, sample_view
from render.category import ViewSpec
from render.depth_renderer import DepthRenderer
from render.farthest_point import farthest_points_first
from render.posing import compose
from render.ray_caster import RayCaster

HONEST_MEAN_DISTANCE = 0.3  # of observed points to their centre, after normalisation; like a complete cloud's
MAX_REJECTED = 200  # views in a row
MAX_RESOLUTION = 2048
_REFERENCE_POINTS = 4096  # number of points to which a category's `min_visible_points` refers

RENDERERS = {"egl": DepthRenderer, "ray-caster": RayCaster}


@dataclass(frozen=True)
class PartialCloud:
    """One view of a posed object.

    Attributes:
        points: [P, 3] metric, camera frame, the first 2048 in farthest-point order.
        part_id: [P].
        rotation: [3, 3] object frame -> camera frame.
        translation: [3] object frame -> camera frame, metric.
        center: [3] and
        scale: of the protocol's normalisation, metric.
        rejected_views: Views drawn before this one in which a part showed too few points.
    """

    points: np.ndarray
    part_id: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    scale: float
    rejected_views: int


class DepthSensor:
    """Takes partial clouds of one instance."""

    def __init__(
        self,
        instance: ArticulatedObject,
        view: ViewSpec,
        renderer: str,
        protocol: str,
        resolution: int,
        num_points: int,
        min_visible_points: int,
        noise_std: float,
    ) -> None:
        """Prepare the renderer.

        Args:
            instance: The instance.
            view: Range of views.
            renderer: One of `RENDERERS`.
            protocol: `honest` or `eap`.
            resolution: Width and height of the depth image; doubled for views that show fewer pixels than points.
            num_points: P.
            min_visible_points: Every part must have this many of 4096 points, or the same share of P.
            noise_std: Standard deviation of Gaussian depth noise, in rest-state bounding-box diagonals.

        Raises:
            RendererUnavailable: if the renderer is `egl` and there is no working EGL.
        """
        self._instance = instance
        self._view = view
        self._renderer = RENDERERS[renderer](instance.meshes)
        self._protocol = protocol
        self._resolution = resolution
        self._num_points = num_points
        self._min_visible = int(np.ceil(min_visible_points * num_points / _REFERENCE_POINTS))
        self._noise_std = noise_std * instance.rest_diagonal
        corners = np.array([trimesh.bounds.corners(mesh.bounds) for mesh in instance.meshes])  # [K, 8, 3]
        self._corners = np.concatenate([corners, np.ones_like(corners[..., :1])], axis=-1)
        self._areas = np.array([mesh.area for mesh in instance.meshes])
        self._centroids = np.array([[*mesh.centroid, 1.0] for mesh in instance.meshes])  # [K, 4]

    def observe(
        self,
        motion: np.ndarray,  # [K, 4, 4], of the parts in the object frame
        rng: np.random.Generator,
    ) -> PartialCloud:
        """A partial cloud from a random view that shows every part.

        Raises:
            ValueError: if no such view is found.
        """
        corners = np.einsum("kab,kcb->kca", motion[:, :3], self._corners).reshape(-1, 3)
        target = 0.5 * (corners.min(0) + corners.max(0))
        radius = float(np.linalg.norm(corners - target, axis=1).max())
        for rejected in range(MAX_REJECTED):
            rotation, translation = sample_view(self._view, target, radius, rng)
            pose = compose(rotation, translation, motion)
            points, part_id = self._depth_points(pose, rng)
            visible = np.bincount(part_id, minlength=self._instance.num_parts)
            if visible.min() >= self._min_visible:
                center, scale = self._normalisation(points, pose)
                return PartialCloud(points, part_id, rotation, translation, center, scale, rejected)
        hidden = self._instance.part_names[int(visible.argmin())]
        raise ValueError(
            f"{self._instance.category} instance {self._instance.name!r}: none of {MAX_REJECTED} views shows "
            f"{self._min_visible} points of part {hidden!r}; widen the category's view range or lower its "
            f"min_visible_points"
        )

    def _depth_points(self, pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """P points and their part ids, chosen uniformly from the pixels that see the object."""
        resolution = self._resolution
        while True:
            camera = Camera(resolution)
            depth, part_id = self._pixels(pose, camera)
            seen = np.flatnonzero(part_id != BACKGROUND)
            if len(seen) >= self._num_points:
                break
            resolution *= 2
            if resolution > MAX_RESOLUTION:
                raise ValueError(
                    f"{self._instance.category} instance {self._instance.name!r}: a view shows fewer than "
                    f"{self._num_points} pixels of it even at {MAX_RESOLUTION} pixels width; lower --points"
                )
        chosen = rng.choice(seen, self._num_points, replace=False)
        chosen_depth = depth[chosen].astype(float)
        if self._noise_std > 0:
            chosen_depth += rng.normal(0.0, self._noise_std, len(chosen))
        points = camera.back_project(chosen % camera.resolution**2, chosen_depth)
        order = farthest_points_first(points)
        return points[order], part_id[chosen[order]]

    def _pixels(self, pose: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Flattened depth and part ids: of one image, or under `eap` of one image after another for every part."""
        if self._protocol == "honest":
            depth, part_id = self._renderer.render(pose, camera)
            return depth.ravel(), part_id.ravel()
        images = [self._renderer.render(pose, camera, parts=[part]) for part in range(len(pose))]
        return tuple(np.concatenate([image.ravel() for image in kind]) for kind in zip(*images, strict=True))

    def _normalisation(self, points: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, float]:
        if self._protocol == "honest":
            center = points.mean(0)
            return center, float(np.linalg.norm(points - center, axis=1).mean()) / HONEST_MEAN_DISTANCE
        centroids = np.einsum("kab,kb->ka", pose[:, :3], self._centroids)
        return self._areas @ centroids / self._areas.sum(), self._instance.rest_diagonal
