"""Hand a prediction over in the frame and the units of the user's scan: JSON, coloured clouds, URDF, a picture.

Convention of `prediction.json` (schema 1):
    Lengths are in the units of the scan, angles in radians. Poses are 4x4, row by row, and act on column vectors.
    `parts[k].pose` maps the canonical space of part k to the frame of the scan, `base_pose` the canonical object space.
    `parts[k].assembly` is the translation from the canonical space of part k to the canonical object space. A joint's
    `axis` and `pivot` live in the frame of the scan, `canonical_axis` and `canonical_pivot` in the canonical object
    space; `state` and `limits` are relative to the canonical object shape. `reconstruction_error` and
    `kinematic_error` are lengths. (scan - center) / scale is what the network saw.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from articulate_ssl.inference.articulation import articulate, posed_parts, to_input_frame
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.part_colour import part_colour
from articulate_ssl.inference.picture import draw_prediction
from articulate_ssl.inference.point_cloud_io import save_coloured_ply
from articulate_ssl.inference.urdf import JOINT_TYPE_NAMES, write_urdf
from articulate_ssl.prediction import Prediction
from datamodules.atomic import atomic_write
from datamodules.geometry import PRISMATIC

SCHEMA_VERSION = 1
MAX_DRAWN_POINTS = 4096


def part_of_points(
    prediction: Prediction,  # B = 1, of `points`
    points: np.ndarray,  # [N, 3] the network's input
    cloud: np.ndarray,  # [M, 3] the whole scan, same frame as `points`
) -> np.ndarray:  # [M] part indices
    """Part of every point of the whole scan: that of the nearest point that the network saw."""
    return prediction.part_id[0].cpu().numpy()[cKDTree(points).query(cloud)[1]]


def write_prediction(
    folder: str | os.PathLike,
    prediction: Prediction,  # B = 1, normalised space
    points: np.ndarray,  # [N, 3] the network's input, normalised
    center: np.ndarray,  # [3]
    scale: float,
    cloud: np.ndarray,  # [M, 3] the user's scan, not normalised
    state_range: Tensor,  # [J, 2] lowest and highest joint state, normalised units
    category: str,
    checkpoint: str,
) -> list[Path]:
    """Write `parts.ply`, `reconstruction.ply`, `object.urdf`, `meshes/part_<k>.stl`, `picture.png`, `prediction.json`.

    Every file is replaced whole or not at all, and nothing else in `folder` is touched. The JSON comes last: where it
    is new, the rest is.

    Returns:
        The files written.

    Raises:
        ValueError: if `prediction` holds more than one cloud.
        CheckpointError: if `prediction` is not finite.
    """
    if len(prediction.part_id) != 1:
        raise ValueError(f"write_prediction writes one cloud at a time, got a batch of {len(prediction.part_id)}")
    broken = [f.name for f in fields(prediction) if not getattr(prediction, f.name).isfinite().all()]
    if broken:
        raise CheckpointError(
            f"{checkpoint}: predicts NaN or infinite values ({', '.join(broken)}); its training diverged, train again"
        )
    folder = Path(folder)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    metric = to_input_frame(prediction.to("cpu"), torch.as_tensor(center, dtype=torch.float64), scale)
    prismatic = (metric.joint_type[0] == PRISMATIC)[:, None]
    limits = torch.where(prismatic, state_range.cpu().double() * scale, state_range.cpu().double())
    part_id = part_of_points(prediction, points, (cloud - center) / scale)

    files = [folder / "parts.ply", folder / "reconstruction.ply"]
    save_coloured_ply(files[0], cloud, part_colour(part_id))
    shapes = posed_parts(metric)[0]
    colours = part_colour(np.arange(metric.num_parts))
    save_coloured_ply(files[1], shapes.reshape(-1, 3).numpy(), np.repeat(colours, shapes.shape[1], axis=0))
    files += write_urdf(folder, metric, limits, category)
    files.append(folder / "picture.png")
    drawn = np.random.default_rng(0).permutation(len(cloud))[:MAX_DRAWN_POINTS]
    draw_prediction(metric, cloud[drawn], part_id[drawn], limits, files[-1])
    files.append(folder / "prediction.json")
    summary = describe(metric, part_id, limits)
    summary |= {
        "category": category,
        "checkpoint": checkpoint,
        "center": list(map(float, center)),
        "scale": float(scale),
    }
    with atomic_write(files[-1]) as file:
        file.write(_compact_json(summary).encode())
    return files


def describe(
    prediction: Prediction,  # B = 1, input frame
    part_id: np.ndarray,  # [M] part of every point of the scan
    limits: Tensor,  # [J, 2]
) -> dict:
    """The content of `prediction.json` (see the module's convention), as far as the prediction knows it."""
    shape, pose = prediction.part_shape[0], prediction.part_pose[0]
    parents = _parents(prediction)
    counts = np.bincount(part_id, minlength=prediction.num_parts)
    parts = [
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
    joints = [
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
    return {
        "schema_version": SCHEMA_VERSION,
        "units": {"length": "that of the input cloud", "angle": "radian", "frame": "that of the input cloud"},
        "base": parents.index(None),
        "base_pose": prediction.base_pose[0].tolist(),
        "parts": parts,
        "joints": joints,
        "reconstruction_error": float(prediction.reconstruction_error[0]),
        "kinematic_error": kinematic_error(prediction),
    }


def kinematic_error(prediction: Prediction) -> float:
    """Mean distance (B = 1) between the parts as posed and as the joints move them; 0 if the poses obey the joints."""
    difference = posed_parts(prediction) - articulate(prediction, prediction.joint_state)
    return float(difference.norm(dim=-1).mean())


def _parents(prediction: Prediction) -> list[int | None]:
    parents: list[int | None] = [None] * prediction.num_parts
    for parent, child in zip(prediction.joint_parent[0].tolist(), prediction.joint_child[0].tolist(), strict=True):
        parents[child] = parent
    return parents


def _compact_json(content: dict) -> str:
    """Indented JSON with every list of numbers on one line."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    return re.sub(r"\[\n[^\[\]{}]*\]", lambda numbers: f"[{' '.join(numbers[0][1:-1].split())}]", text)
