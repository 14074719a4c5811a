"""Depth and part ids by rasterisation: pyrender on EGL, all parts in one scene, one pass."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh

from render.camera import FIELD_OF_VIEW, Camera

# Read once, when pyrender is first imported.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

_OPENGL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
_DEPTH_MARGIN = 0.01  # of the depth at which near and far plane stand; a tight range makes 24-bit depth exact


class RendererUnavailable(OSError):
    """OpenGL cannot render offscreen on this machine; the message says why."""


class DepthRenderer:
    """Renders the parts of one object; between frames only their poses change.

    Uses pyrender's segmentation pass: unlike its depth pass it is not multisampled, so depth is exact at pixel centres,
    and it returns part ids with the depth. That pass culls back faces whatever its flags say, so surfaces that can be
    seen from behind get reversed faces.
    """

    def __init__(self, meshes: Sequence[trimesh.Trimesh]) -> None:
        """Put the part meshes into a scene.

        Raises:
            RendererUnavailable: if there is no working EGL.
        """
        self._gl = offscreen_renderer()
        import pyrender

        self._flags = pyrender.RenderFlags.SEG
        self._scene = pyrender.Scene()
        self._camera = pyrender.PerspectiveCamera(yfov=FIELD_OF_VIEW, znear=0.1, zfar=10.0, aspectRatio=1.0)
        self._scene.add(self._camera)
        self._nodes = [
            self._scene.add(pyrender.Mesh([pyrender.Primitive(positions=vertices, indices=faces)]))
            for vertices, faces in (_drawn_from_both_sides(mesh) for mesh in meshes)
        ]
        corners = np.array([trimesh.bounds.corners(mesh.bounds) for mesh in meshes]).reshape(-1, 8, 3)
        self._corners = np.concatenate([corners, np.ones_like(corners[..., :1])], axis=-1)  # [K, 8, 4]

    def render(
        self,
        part_pose: np.ndarray,  # [K, 4, 4], object at rest -> camera frame
        camera: Camera,
        parts: Sequence[int] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:  # [H, W] float32 and [H, W] uint8
        """Depth and part id of every pixel; 0 and `BACKGROUND` where nothing is seen.

        Args:
            part_pose: Poses of all parts.
            camera: The camera.
            parts: Indices of the parts to draw, by default all.

        Raises:
            ValueError: if the camera is inside the object.
        """
        depth = np.einsum("kb,kcb->kc", part_pose[:, 2], self._corners)
        near, far = depth.min(), depth.max()
        if near <= 0:
            raise ValueError(f"the camera is inside the object: its parts begin at depth {near:.3g}")
        self._camera.znear, self._camera.zfar = near * (1 - _DEPTH_MARGIN), far * (1 + _DEPTH_MARGIN)
        for node, pose in zip(self._nodes, part_pose, strict=True):
            self._scene.set_pose(node, _OPENGL_FROM_CAMERA @ pose)
        drawn = range(len(self._nodes)) if parts is None else parts
        colors = {self._nodes[part]: (part + 1, 0, 0) for part in drawn}
        self._gl.viewport_width = self._gl.viewport_height = camera.resolution
        color, image = self._gl.render(self._scene, self._flags, colors)
        return image, color[..., 0] - np.uint8(1)  # the background 0 wraps to BACKGROUND


def _drawn_from_both_sides(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:  # [V, 3] and [F, 3]
    """Vertices and faces, with reversed faces added unless the mesh is closed and faces outwards."""
    faces = np.asarray(mesh.faces)
    if not _is_solid(mesh):
        faces = np.concatenate([faces, faces[:, ::-1]])
    return np.asarray(mesh.vertices, dtype=np.float32), faces


def _is_solid(mesh: trimesh.Trimesh) -> bool:
    """Whether every connected body of the mesh is closed and has its faces outwards."""
    if not mesh.is_volume:
        return False
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    corner_a, corner_b, corner_c = np.moveaxis(mesh.triangles - mesh.centroid, 1, 0)
    volume = np.bincount(body, weights=np.einsum("fa,fa->f", corner_a, np.cross(corner_b, corner_c)))
    return bool((volume > 0).all())


@cache
def offscreen_renderer():
    """The process's one OpenGL context."""
    try:
        import pyrender

        return pyrender.OffscreenRenderer(64, 64)
    # PyOpenGL reports a missing driver as ImportError, AttributeError, GLError and others.
    except Exception as error:
        raise RendererUnavailable(f"no offscreen OpenGL ({type(error).__name__}: {error})") from error
