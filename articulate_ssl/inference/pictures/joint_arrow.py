"""Where the arrow of a joint is drawn."""

from __future__ import annotations

import numpy as np

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.articulation import canonical_object
from articulate_ssl.inference.prediction import Prediction


def joint_arrow(
    prediction: Prediction,  # B = 1
    joint: int,
) -> np.ndarray:  # [3, 3] tail, middle, tip, in canonical object space
    """The joint line where it passes the part that it moves, a little longer than that part.

    The tip is where the axis points: a positive state turns counter-clockwise seen from there, or slides towards it.
    """
    axis = prediction.canonical_axis[0, joint].double().numpy()
    pivot = prediction.canonical_pivot[0, joint].double().numpy()
    part = canonical_object(prediction)[0, prediction.joint_child[0, joint]].double().numpy()
    along = (part - pivot) @ axis
    middle = (part.min(axis=0) + part.max(axis=0)) / 2
    anchor = middle if prediction.joint_type[0, joint] == PRISMATIC else pivot + axis * (along.min() + along.max()) / 2
    reach = 0.6 * max(np.ptp(along), 0.6 * np.ptp(part, axis=0).max())
    return np.stack([anchor - axis * reach, anchor, anchor + axis * reach])
