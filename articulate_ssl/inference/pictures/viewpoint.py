"""From where to look at a predicted object."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.articulation import articulate, canonical_object, to_canonical
from articulate_ssl.inference.prediction import Prediction

AZIMUTH, ELEVATION = np.radians(-32.0), np.radians(24.0)

# Upright cameras (`render/categories`) look down on their objects by 25 to 45 degrees in the mean, with the object's
# front to them. Canonical object space is then turned as the mean camera is: x right, y down, z forward.
MEAN_CAMERA_ELEVATION = np.radians(35.0)
# Up is taken to be a direction that the object has itself, if one is nearer than this to the mean camera's up: twice
# what the categories' mean elevations differ from the above. Chosen without a measurement.
OWN_DIRECTION = np.radians(20.0)


def viewing_rotation(
    prediction: Prediction,  # B = 1
    state_range: Tensor,  # [J, 2]
    upright: bool = False,
) -> np.ndarray:  # [3, 3] canonical object space -> (right, up, towards the viewer)
    """A three-quarter view of the object that `level_frame` stands on its feet."""
    return three_quarter_view() @ level_frame(prediction, state_range, upright)


def three_quarter_view() -> np.ndarray:  # [3, 3] (right, up, front) -> (right, up, towards the viewer)
    """Of an object that stands on its feet, its front to the viewer."""
    c, s = np.cos(AZIMUTH), np.sin(AZIMUTH)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(ELEVATION), np.sin(ELEVATION)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ turn


def level_frame(
    prediction: Prediction,  # B = 1
    state_range: Tensor,  # [J, 2]
    upright: bool = False,
) -> np.ndarray:  # [3, 3] canonical object space -> (right, up, front)
    """The object as it stands, whatever frame the training chose as canonical, seen from straight in front.

    `upright` says that the network was trained on clouds of an upright camera, so that canonical object space tells up
    and front. Otherwise both are chosen so that the object is shown open. A first joint that turns has its axis across
    the picture and behind the object; up is the principal direction of the base to which its part opens, a thin one
    before a thick one. A first joint that slides comes towards the viewer; up is the direction in which several sliding
    parts are stacked.
    """
    shape = canonical_object(prediction)[0].double().numpy()
    base = (set(range(prediction.num_parts)) - set(prediction.joint_child[0].tolist())).pop()
    directions, spread = _principal_directions(shape[base])
    if upright:
        return _level(_own_up(prediction, directions), back=np.array([0.0, 0.0, 1.0]))
    if not len(state_range):
        return _level(up=directions[0], back=directions[1])

    axis = prediction.canonical_axis[0, 0].double().numpy()
    if prediction.joint_type[0, 0] == PRISMATIC:
        back = -axis * (np.sign(state_range[0].mean().item()) or 1.0)
        sliding = np.delete(shape, base, axis=0).mean(axis=1)
        stacked = _principal_directions(sliding)[0][::-1] if len(sliding) > 1 else directions
        return _level(up=next(d for d in (*stacked, *directions) if abs(d @ axis) < 0.7), back=back)

    halfway = articulate(prediction, state_range.to(prediction.joint_state).mean(dim=1))[
        0, prediction.joint_child[0, 0]
    ]
    pivot = prediction.canonical_pivot[0, 0].double().numpy()
    opening = to_canonical(prediction, halfway).numpy().mean(axis=0) - pivot
    across = np.abs(directions @ axis) < 0.7
    up = directions[np.argmax(across * (np.abs(directions @ opening) + 1e-9) / (spread + 1e-9))]
    up = up if up @ opening >= 0 else -up
    back = np.cross(up, axis)
    return _level(up, back if (pivot - shape[base].mean(axis=0)) @ back >= 0 else -back)


def _own_up(
    prediction: Prediction,
    directions: np.ndarray,  # [3, 3] principal directions of the base, as rows
) -> np.ndarray:  # [3]
    """The mean camera's up, or the direction of the object's own that is next to it."""
    camera = np.array([0.0, -np.cos(MEAN_CAMERA_ELEVATION), -np.sin(MEAN_CAMERA_ELEVATION)])
    own = np.concatenate([directions, prediction.canonical_axis[0].double().numpy()])
    nearest = own[np.argmax(np.abs(own @ camera))]
    if abs(nearest @ camera) < np.cos(OWN_DIRECTION):
        return camera
    return nearest * np.sign(nearest @ camera)


def _principal_directions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions [3, 3] as rows and standard deviations [3] along them, the least first."""
    variance, directions = np.linalg.eigh(np.cov(points, rowvar=False))
    return directions.T, np.sqrt(variance.clip(min=0))


def _level(up: np.ndarray, back: np.ndarray) -> np.ndarray:
    back = back - (back @ up) * up
    back = back / np.linalg.norm(back)
    return np.stack([np.cross(back, up), up, -back])
