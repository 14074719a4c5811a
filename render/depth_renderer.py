"""Depth and part ids by rasterisation: OpenGL through EGL, all parts in one scene, one pass."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh

from render.camera import BACKGROUND, FIELD_OF_VIEW, Camera

# Read once, when PyOpenGL is first imported.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

_DEPTH_MARGIN = 0.01  # of the depth at which near and far plane stand; a tight range makes the 24-bit z-buffer sharp
_VERTEX_SHADER = """#version 330
layout(location = 0) in vec3 position;
uniform mat4 pose;
uniform vec3 projection;
out float depth;
void main() {
    vec4 seen = pose * vec4(position, 1.0);
    depth = seen.z;
    gl_Position = vec4(projection.x * seen.xy, projection.y * seen.z + projection.z, seen.z);
}"""
_FRAGMENT_SHADER = """#version 330
in float depth;
uniform float part;
out vec2 pixel;
void main() { pixel = vec2(depth, part); }"""


class RendererUnavailable(OSError):
    """OpenGL cannot render offscreen on this machine; the message says why."""


class DepthRenderer:
    """Renders the parts of one object; between frames only their poses change.

    Depth and part id come out of the shader as floats, not multisampled, so both are exact at pixel centres; pyrender,
    which could do the same in its segmentation pass, takes three times as long. Back faces are culled, so surfaces that
    can be seen from behind get reversed faces.
    """

    def __init__(self, meshes: Sequence[trimesh.Trimesh]) -> None:
        """Upload the part meshes.

        Raises:
            RendererUnavailable: if there is no working EGL.
        """
        self._rasterizer = _rasterizer()
        surfaces = [self._rasterizer.upload(*_drawn_from_both_sides(mesh)) for mesh in meshes]
        self._surfaces = surfaces
        # Not at exit, when the context is gone before its objects.
        weakref.finalize(self, self._rasterizer.delete, surfaces).atexit = False
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
        near, far = near * (1 - _DEPTH_MARGIN), far * (1 + _DEPTH_MARGIN)
        drawn = range(len(self._surfaces)) if parts is None else parts
        scene = [(self._surfaces[part], part_pose[part], part) for part in drawn]
        pixels = self._rasterizer.draw(scene, near, far, camera.resolution)
        return pixels[..., 0], pixels[..., 1].astype(np.uint8)


class _Rasterizer:
    """An OpenGL context with the one shader program; it knows nothing of cameras and parts beyond their numbers."""

    def __init__(self) -> None:
        self._context = offscreen_context()
        self._context.make_current()
        from OpenGL import GL as gl
        from OpenGL.GL import shaders

        self._gl = gl
        gl.glBindVertexArray(gl.glGenVertexArrays(1))  # without one, programs do not pass their validation
        self._program = shaders.compileProgram(
            shaders.compileShader(_VERTEX_SHADER, gl.GL_VERTEX_SHADER),
            shaders.compileShader(_FRAGMENT_SHADER, gl.GL_FRAGMENT_SHADER),
        )
        gl.glUseProgram(self._program)
        self._pose, self._projection, self._part = (
            gl.glGetUniformLocation(self._program, name) for name in ("pose", "projection", "part")
        )
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glEnable(gl.GL_CULL_FACE)
        gl.glFrontFace(gl.GL_CW)  # y points down in the camera frame, up in OpenGL's: the image arrives top row first
        gl.glClearColor(0.0, float(BACKGROUND), 0.0, 0.0)
        self._resolution = 0
        self._framebuffer, self._attachments = gl.glGenFramebuffers(1), gl.glGenRenderbuffers(2)

    def upload(
        self,
        vertices: np.ndarray,  # [V, 3]
        faces: np.ndarray,  # [F, 3]
    ) -> tuple[int, list[int], int]:
        """A mesh as a vertex array object, its buffers, and the number of its indices."""
        gl = self._gl
        self._context.make_current()
        surface, buffers = gl.glGenVertexArrays(1), gl.glGenBuffers(2)
        gl.glBindVertexArray(surface)
        for target, buffer, content in (
            (gl.GL_ARRAY_BUFFER, buffers[0], np.ascontiguousarray(vertices, dtype=np.float32)),
            (gl.GL_ELEMENT_ARRAY_BUFFER, buffers[1], np.ascontiguousarray(faces, dtype=np.uint32)),
        ):
            gl.glBindBuffer(target, buffer)
            gl.glBufferData(target, content.nbytes, content, gl.GL_STATIC_DRAW)
        gl.glEnableVertexAttribArray(0)
        gl.glVertexAttribPointer(0, 3, gl.GL_FLOAT, False, 0, None)
        return surface, buffers, faces.size

    def delete(self, surfaces: Sequence[tuple[int, list[int], int]]) -> None:
        """Free uploaded meshes."""
        self._context.make_current()
        for surface, buffers, _ in surfaces:
            self._gl.glDeleteVertexArrays(1, [surface])
            self._gl.glDeleteBuffers(2, buffers)

    def draw(
        self,
        scene: Sequence[tuple[tuple[int, list[int], int], np.ndarray, int]],  # surface, pose [4, 4], number
        near: float,
        far: float,
        resolution: int,
    ) -> np.ndarray:  # [H, W, 2] float32
        """Depth and number of the surface at every pixel centre; 0 and `BACKGROUND` where there is none."""
        gl = self._gl
        self._context.make_current()
        if resolution != self._resolution:
            self._resize(resolution)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        focal_length = 1 / np.tan(0.5 * FIELD_OF_VIEW)
        gl.glUniform3f(self._projection, focal_length, (far + near) / (far - near), -2 * far * near / (far - near))
        for (surface, _, size), pose, number in scene:
            gl.glUniformMatrix4fv(self._pose, 1, True, pose.astype(np.float32))
            gl.glUniform1f(self._part, number)
            gl.glBindVertexArray(surface)
            gl.glDrawElements(gl.GL_TRIANGLES, size, gl.GL_UNSIGNED_INT, None)
        pixels = np.empty((resolution, resolution, 2), dtype=np.float32)
        gl.glReadPixels(0, 0, resolution, resolution, gl.GL_RG, gl.GL_FLOAT, pixels)
        return pixels

    def _resize(self, resolution: int) -> None:
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        for attachment, buffer, kind in (
            (gl.GL_COLOR_ATTACHMENT0, self._attachments[0], gl.GL_RG32F),
            (gl.GL_DEPTH_ATTACHMENT, self._attachments[1], gl.GL_DEPTH_COMPONENT24),
        ):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, kind, resolution, resolution)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, attachment, gl.GL_RENDERBUFFER, buffer)
        gl.glViewport(0, 0, resolution, resolution)
        self._resolution = resolution


@cache
def _rasterizer() -> _Rasterizer:
    """The process's one."""
    return _Rasterizer()


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
def offscreen_context():
    """An OpenGL context of this process without a window, a `pyrender.platforms.egl.EGLPlatform`.

    Raises:
        RendererUnavailable: if there is no working EGL.
    """
    try:
        from pyrender.platforms import egl

        context = egl.EGLPlatform(1, 1, egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0"))))
        context.init_context()
    # PyOpenGL reports a missing driver as ImportError, AttributeError, GLError and others.
    except Exception as error:
        raise RendererUnavailable(f"no offscreen OpenGL ({type(error).__name__}: {error})") from error
    return context
