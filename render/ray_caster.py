"""Depth and part ids by ray casting: the fallback where EGL is missing, and the oracle that tests compare with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d
import trimesh

from render.camera import BACKGROUND, Camera


class RayCaster:
    """Drop-in replacement of `render.depth_renderer.DepthRenderer`; exact to float32, but slower."""

    def __init__(self, meshes: Sequence[trimesh.Trimesh]) -> None:
        self._meshes = tuple(meshes)

    def render(
        self,
        part_pose: np.ndarray,  # [K, 4, 4], object at rest -> camera frame
        camera: Camera,
        parts: Sequence[int] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:  # [H, W] float32 and [H, W] uint8
        """Depth and part id of every pixel; 0 and `BACKGROUND` where nothing is seen."""
        drawn = range(len(self._meshes)) if parts is None else parts
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        part_of = np.full(len(self._meshes) + 1, BACKGROUND, dtype=np.uint8)
        for part in drawn:
            vertices = trimesh.transform_points(self._meshes[part].vertices, part_pose[part])
            geometry = scene.add_triangles(vertices.astype(np.float32), self._meshes[part].faces.astype(np.uint32))
            part_of[geometry] = part
        directions = camera.rays()
        hits = scene.cast_rays(np.concatenate([np.zeros_like(directions), directions], axis=-1), nthreads=1)
        depth = hits["t_hit"].numpy()
        seen = np.isfinite(depth)
        geometry = np.where(seen, hits["geometry_ids"].numpy(), len(self._meshes))
        return np.where(seen, depth, np.float32(0)), part_of[geometry]
