"""Shaded pictures of posed objects, for people to look at: no data is made from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import laplace

from render.articulated_object import ArticulatedObject
from render.camera import look_at_rotation
from render.depth_renderer import offscreen_context

# Base in grey, moving parts in the colour-blind safe palette of Okabe and Ito.
PART_COLORS = np.array(
    [(0.66, 0.67, 0.70), (0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65)]
)
_FIELD_OF_VIEW = np.deg2rad(28.0)
_MARGIN = 1.08  # of the picture's half width over the object's
_CREASE_STEP = 0.01  # relative depth step between neighbouring pixels that is drawn black
_LIGHTS = ((30.0, 60.0, 2.2), (-50.0, 20.0, 1.3), (55.0, 10.0, 0.8))  # azimuth and elevation in degrees, intensity
_OPENGL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Viewpoint:
    """A camera that frames an object.

    Attributes:
        rotation: [3, 3] object frame -> camera frame (x right, y down, z forward).
        translation: [3].
    """

    rotation: np.ndarray
    translation: np.ndarray

    def project(
        self,
        points: np.ndarray,  # [N, 3], object frame
    ) -> np.ndarray:  # [N, 2]
        """Image coordinates; the picture spans [-1, 1] to the right and downwards."""
        camera = points @ self.rotation.T + self.translation
        return camera[:, :2] / (camera[:, 2:] * np.tan(0.5 * _FIELD_OF_VIEW))


def frame(
    points: np.ndarray,  # [N, 3], object frame
    azimuth: float = np.deg2rad(32.0),
    elevation: float = np.deg2rad(28.0),
) -> Viewpoint:
    """The viewpoint in a direction (radians, as in `look_at_rotation`) from which the points just fill the picture."""
    rotation = look_at_rotation(azimuth, elevation, 0.0)
    seen = points @ rotation.T
    across, depth = seen[:, :2], seen[:, 2:]
    # A point is inside the frustum of apex a if |across - a| <= slope * (depth - a_z): two planes touch it per side.
    slope = np.tan(0.5 * _FIELD_OF_VIEW) / _MARGIN
    high, low = (across - slope * depth).max(0), (across + slope * depth).min(0)
    apex = np.array([*(0.5 * (high + low)), ((low - high) / (2 * slope)).min()])
    return Viewpoint(rotation, -apex)


def posed_vertices(
    instance: ArticulatedObject,
    states: np.ndarray,  # [J] joint coordinates
) -> np.ndarray:  # [N, 3]
    """Vertices of all parts, object frame."""
    pairs = zip(instance.meshes, instance.part_motion(states), strict=True)
    return np.concatenate([mesh.vertices @ pose[:3, :3].T + pose[:3, 3] for mesh, pose in pairs])


def shaded_picture(
    instance: ArticulatedObject,
    states: np.ndarray,  # [J] joint coordinates
    viewpoint: Viewpoint,
    resolution: int,
) -> np.ndarray:  # [H, W, 3] uint8
    """Lit picture of an object with its edges drawn, one colour per part.

    Raises:
        RendererUnavailable: if there is no working EGL.
    """
    renderer = _renderer()
    import pyrender

    scene = pyrender.Scene(bg_color=(1.0, 1.0, 1.0, 1.0), ambient_light=(0.3, 0.3, 0.3))
    for part, (mesh, pose) in enumerate(zip(instance.meshes, instance.part_motion(states), strict=True)):
        color = (*PART_COLORS[part % len(PART_COLORS)] ** 2.2, 1.0)
        material = pyrender.MetallicRoughnessMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.8)
        scene.add(pyrender.Mesh.from_trimesh(mesh, material=material, smooth=False), pose=pose)
    distance = float(np.linalg.norm(viewpoint.translation))
    camera = pyrender.PerspectiveCamera(_FIELD_OF_VIEW, znear=0.02 * distance, zfar=10 * distance, aspectRatio=1.0)
    scene.add(camera, pose=_opengl_pose(viewpoint.rotation, viewpoint.translation))
    for azimuth, elevation, intensity in _LIGHTS:
        rotation = look_at_rotation(np.deg2rad(azimuth), np.deg2rad(elevation), 0.0)
        scene.add(pyrender.DirectionalLight(intensity=intensity), pose=_opengl_pose(rotation, np.zeros(3)))
    renderer.viewport_width = renderer.viewport_height = resolution
    color, depth = renderer.render(scene)
    return (color * (1.0 - 0.75 * _creases(depth, distance)[..., None])).astype(np.uint8)


@cache
def _renderer():
    """The process's one `pyrender.OffscreenRenderer`."""
    offscreen_context()  # fails with a clear message where pyrender would not
    import pyrender

    return pyrender.OffscreenRenderer(64, 64)


def _opengl_pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:  # [4, 4]
    """Pose in the object frame of an OpenGL camera (looking along -z, y up)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ translation
    return pose @ _OPENGL_FROM_CAMERA


def _creases(
    depth: np.ndarray,  # [H, W], 0 where nothing is seen
    distance: float,
) -> np.ndarray:  # [H, W] in [0, 1]
    """Edges and steps: inverse depth is linear in the image across a plane, so its Laplacian is zero elsewhere."""
    inverse = np.divide(distance, depth, out=np.zeros_like(depth), where=depth > 0)
    return np.clip(np.abs(laplace(inverse)) / _CREASE_STEP, 0.0, 1.0)
