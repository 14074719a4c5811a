"""The pinhole camera of the partial views.

Convention:
    Camera frame: x right, y down, z forward. The centre of pixel (u, v), counted from the top left, lies at
    (u + 0.5, v + 0.5) on the image plane; depth is the z coordinate, 0 where nothing is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from render.category import ViewSpec

FIELD_OF_VIEW = np.deg2rad(60.0)
_DISTANCE_RANGE = (1.0, 1.3)  # of the distance at which the object's bounding sphere fills the image
BACKGROUND = 255  # part id of pixels that see nothing


@dataclass(frozen=True)
class Camera:
    """A square pinhole camera with the principal point in the middle of the image."""

    resolution: int

    @property
    def focal_length(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.resolution / np.tan(0.5 * FIELD_OF_VIEW)

    def rays(self) -> np.ndarray:  # [H, W, 3]
        """Directions through all pixel centres, with z = 1 (float32)."""
        axis = (np.arange(self.resolution) + 0.5 - 0.5 * self.resolution) / self.focal_length
        x, y = np.meshgrid(axis, axis)
        return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)

    def back_project(
        self,
        pixels: np.ndarray,  # [N] indices into the flattened image
        depth: np.ndarray,  # [N]
    ) -> np.ndarray:  # [N, 3], camera frame
        """Points seen by the given pixels."""
        v, u = np.divmod(pixels, self.resolution)
        image_plane = np.stack([u, v], axis=1) + (0.5 - 0.5 * self.resolution)
        return np.concatenate([image_plane * (depth / self.focal_length)[:, None], depth[:, None]], axis=1)


def sample_view(
    spec: ViewSpec,
    target: np.ndarray,  # [3], point to look at, object frame
    radius: float,  # of a sphere round the target that holds the object
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # [3, 3] and [3]
    """Rotation and translation from the object to the camera frame, of a camera within the category's view range."""
    azimuth, elevation, roll = (rng.uniform(*bounds) for bounds in (spec.azimuth, spec.elevation, spec.roll))
    distance = radius / np.sin(0.5 * FIELD_OF_VIEW) * rng.uniform(*_DISTANCE_RANGE)
    rotation = look_at_rotation(azimuth, elevation, roll)
    return rotation, np.array([0.0, 0.0, distance]) - rotation @ target


def look_at_rotation(azimuth: float, elevation: float, roll: float) -> np.ndarray:  # [3, 3]
    """Rotation from the object frame (y up, z to the front) to the camera frame.

    Convention:
        Azimuth 0 looks at the front, growing azimuth moves the camera to the side of +x; growing elevation moves it up;
        growing roll turns the camera clockwise as seen from behind it.
    """
    sine_a, cosine_a = np.sin(azimuth), np.cos(azimuth)
    sine_e, cosine_e = np.sin(elevation), np.cos(elevation)
    forward = -np.array([sine_a * cosine_e, sine_e, cosine_a * cosine_e])
    right = np.array([cosine_a, 0.0, -sine_a])
    down = np.array([sine_a * sine_e, -cosine_e, cosine_a * sine_e])
    sine, cosine = np.sin(roll), np.cos(roll)
    return np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])
