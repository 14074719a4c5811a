"""Contact sheet of a category: what its instances look like, how they move, and what a depth camera sees of them.

python -m render.preview --category laptop --out build/preview
"""

from __future__ import annotations

import os

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import numpy as np
import pyrender
from scipy.ndimage import laplace

from render.articulated_object import ArticulatedObject

# Base in grey, moving parts in the colour-blind safe palette of Okabe and Ito.
PART_COLORS = np.array(
    [(0.72, 0.73, 0.75), (0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65)]
)
FIELD_OF_VIEW = np.deg2rad(28.0)
_CREASE_STEP = 0.01  # relative depth step between neighbouring pixels that is drawn black


def view_from(direction: np.ndarray, target: np.ndarray, distance: float) -> np.ndarray:  # [4, 4]
    """Camera-to-object pose (OpenGL: looking along -z, y up) at a distance from the target, seen from a direction."""
    z = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    x = np.cross((0.0, 1.0, 0.0), z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, np.cross(z, x), z, target + distance * z
    return pose


def render_lit(
    object: ArticulatedObject,
    states: np.ndarray,  # [J] joint coordinates
    camera: np.ndarray,  # [4, 4] camera-to-object pose, OpenGL convention
    renderer: pyrender.OffscreenRenderer,
) -> np.ndarray:  # [H, W, 3] uint8
    """Shaded picture of an object, one colour per part."""
    scene = pyrender.Scene(bg_color=(1.0, 1.0, 1.0, 1.0), ambient_light=(0.25, 0.25, 0.25))
    for part, (mesh, pose) in enumerate(zip(object.meshes, object.part_motion(states), strict=True)):
        color = (*PART_COLORS[part % len(PART_COLORS)], 1.0)
        material = pyrender.MetallicRoughnessMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.7)
        scene.add(pyrender.Mesh.from_trimesh(mesh, material=material, smooth=False), pose=pose)
    distance = np.linalg.norm(camera[:3, 3])
    scene.add(pyrender.PerspectiveCamera(FIELD_OF_VIEW, znear=0.05 * distance, zfar=10 * distance), pose=camera)
    for direction, intensity in (((0.3, 1.0, 0.5), 1.5), ((-1.0, 0.4, 0.8), 0.9), ((0.8, 0.1, 0.6), 0.5)):
        scene.add(pyrender.DirectionalLight(intensity=intensity), pose=view_from(direction, np.zeros(3), 1.0))
    color, depth = renderer.render(scene)
    return (color * (1.0 - 0.75 * _creases(depth, distance)[..., None])).astype(np.uint8)


def _creases(
    depth: np.ndarray,  # [H, W], 0 where nothing is seen
    distance: float,
) -> np.ndarray:  # [H, W] in [0, 1]
    """Edges and steps: inverse depth is linear in the image across a plane, so its Laplacian is zero elsewhere."""
    inverse = np.divide(distance, depth, out=np.zeros_like(depth), where=depth > 0)
    return np.clip(np.abs(laplace(inverse)) / _CREASE_STEP, 0.0, 1.0)
