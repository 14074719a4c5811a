"""From where to look at a predicted object."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.articulation import articulate, canonical_object, to_canonical
from articulate_ssl.inference.prediction import Prediction

AZIMUTH, ELEVATION = np.radians(-32.0), np.radians(24.0)


def viewing_rotation(
    prediction: Prediction,  # B = 1
    state_range: Tensor,  # [J, 2]
) -> np.ndarray:  # [3, 3] canonical object space -> (right, up, towards the viewer)
    """A three-quarter view that shows the object open, whatever frame the training chose as canonical.

    A first joint that turns has its axis across the picture and behind the object; up is the principal direction of the
    base to which its part opens, a thin one before a thick one. A first joint that slides comes towards the viewer; up
    is the direction in which several sliding parts are stacked.
    """
    shape = canonical_object(prediction)[0].double().numpy()
    base = (set(range(prediction.num_parts)) - set(prediction.joint_child[0].tolist())).pop()
    directions, spread = _principal_directions(shape[base])
    if not len(state_range):
        return _three_quarter(up=directions[0], back=directions[1])

    axis = prediction.canonical_axis[0, 0].double().numpy()
    if prediction.joint_type[0, 0] == PRISMATIC:
        back = -axis * (np.sign(state_range[0].mean().item()) or 1.0)
        sliding = np.delete(shape, base, axis=0).mean(axis=1)
        stacked = _principal_directions(sliding)[0][::-1] if len(sliding) > 1 else directions
        return _three_quarter(up=next(d for d in (*stacked, *directions) if abs(d @ axis) < 0.7), back=back)

    halfway = articulate(prediction, state_range.to(prediction.joint_state).mean(dim=1))[
        0, prediction.joint_child[0, 0]
    ]
    pivot = prediction.canonical_pivot[0, 0].double().numpy()
    opening = to_canonical(prediction, halfway).numpy().mean(axis=0) - pivot
    across = np.abs(directions @ axis) < 0.7
    up = directions[np.argmax(across * (np.abs(directions @ opening) + 1e-9) / (spread + 1e-9))]
    up = up if up @ opening >= 0 else -up
    back = np.cross(up, axis)
    return _three_quarter(up, back if (pivot - shape[base].mean(axis=0)) @ back >= 0 else -back)


def _principal_directions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions [3, 3] as rows and standard deviations [3] along them, the least first."""
    variance, directions = np.linalg.eigh(np.cov(points, rowvar=False))
    return directions.T, np.sqrt(variance.clip(min=0))


def _three_quarter(up: np.ndarray, back: np.ndarray) -> np.ndarray:
    back = back - (back @ up) * up
    back = back / np.linalg.norm(back)
    level = np.stack([np.cross(back, up), back, up])
    c, s = np.cos(AZIMUTH), np.sin(AZIMUTH)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ level
    c, s = np.cos(ELEVATION), np.sin(ELEVATION)
    return np.array([[1, 0, 0], [0, s, c], [0, -c, s]]) @ turned
