"""The prediction as numbers.

Convention of `prediction.json` (schema 1):
    Lengths are in the units of the scan, angles in radians. Poses are 4x4, row by row, and act on column vectors.
    `parts[k].pose` maps the canonical space of part k to the frame of the scan, `base_pose` the canonical object space.
    `parts[k].assembly` is the translation from the canonical space of part k to the canonical object space. A joint's
    `axis` and `pivot` live in the frame of the scan, `canonical_axis` and `canonical_pivot` in the canonical object
    space; `state` and `limits` are relative to the canonical object shape. `reconstruction_error` and
    `kinematic_error` are lengths. `margin` is how much better, from 0 to 1, the prediction fits than the best rival
    that is turned another way; it is no probability. `probability` is one, learnt without labels, and `unlike` the
    share of the training clouds that were explained better (both null if not learnt); `warning` says so where it is
    large. (scan - center) / scale is what the network saw.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from torch import Tensor

from articulate_ssl.inference.articulation import articulate, posed_parts
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import JOINT_TYPE_NAMES, ScanPrediction
from datamodules.atomic import atomic_write

SCHEMA_VERSION = 1


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `prediction.json`; return it."""
    file = folder / "prediction.json"
    content = _compact_json(describe(result)).encode()
    with atomic_write(file) as opened:
        opened.write(content)
    return [file]


def describe(result: ScanPrediction) -> dict:
    """The content of `prediction.json` (see the module's convention)."""
    prediction = result.prediction
    parents = _parents(prediction)
    return {
        "schema_version": SCHEMA_VERSION,
        "units": {"length": "that of the input cloud", "angle": "radian", "frame": "that of the input cloud"},
        "base": parents.index(None),
        "base_pose": prediction.base_pose[0].tolist(),
        "parts": _describe_parts(prediction, parents, result.part_id),
        "joints": _describe_joints(prediction, result.limits),
        "reconstruction_error": float(prediction.reconstruction_error[0]),
        "kinematic_error": kinematic_error(prediction),
        "margin": float(prediction.margin[0]),
        "probability": result.probability,
        "unlike": result.unlike,
        "warning": result.warning,
        "category": result.category,
        "checkpoint": result.checkpoint,
        "center": list(map(float, result.center)),
        "scale": float(result.scale),
    }


def kinematic_error(prediction: Prediction) -> float:
    """Mean distance (B = 1) between the parts as posed and as the joints move them; 0 if the poses obey the joints."""
    difference = posed_parts(prediction) - articulate(prediction, prediction.joint_state)
    return float(difference.norm(dim=-1).mean())


def _describe_parts(
    prediction: Prediction,  # B = 1, input frame
    parents: list[int | None],
    part_id: np.ndarray,  # [M] part of every point of the scan
) -> list[dict]:
    shape, pose = prediction.part_shape[0], prediction.part_pose[0]
    counts = np.bincount(part_id, minlength=prediction.num_parts)
    return [
        {
            "id": k,
            "parent": parents[k],
            "pose": pose[k].tolist(),
            "num_points": int(counts[k]),
            "assembly": prediction.assembly[0, k].tolist(),
            "canonical_size": (shape[k].amax(dim=0) - shape[k].amin(dim=0)).tolist(),
            "colour": part_colour(k).tolist(),
        }
        for k in range(prediction.num_parts)
    ]


def _describe_joints(
    prediction: Prediction,  # B = 1, input frame
    limits: Tensor,  # [J, 2]
) -> list[dict]:
    return [
        {
            "name": f"joint_{j}",
            "type": JOINT_TYPE_NAMES[prediction.joint_type[0, j]],
            "parent": int(prediction.joint_parent[0, j]),
            "child": int(prediction.joint_child[0, j]),
            "axis": prediction.joint_axis[0, j].tolist(),
            "pivot": prediction.joint_pivot[0, j].tolist(),
            "state": float(prediction.joint_state[0, j]),
            "limits": limits[j].tolist(),
            "canonical_axis": prediction.canonical_axis[0, j].tolist(),
            "canonical_pivot": prediction.canonical_pivot[0, j].tolist(),
        }
        for j in range(len(limits))
    ]


def _parents(prediction: Prediction) -> list[int | None]:
    parents: list[int | None] = [None] * prediction.num_parts
    for parent, child in zip(prediction.joint_parent[0].tolist(), prediction.joint_child[0].tolist(), strict=True):
        parents[child] = parent
    return parents


def _compact_json(content: dict) -> str:
    """Indented JSON with every list of numbers on one line."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    return re.sub(r"\[\n[^\[\]{}]*\]", lambda numbers: f"[{' '.join(numbers[0][1:-1].split())}]", text)
