"""What `lightning fit` needs to learn a category of the user's own scans: a configuration beside the data."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

import torch

from articulate_ssl.geometry.screw import REVOLUTE
from datamodules.atomic import atomic_write
from render.category import CategorySpec

CONFIG_NAME = "config.yaml"
# In units of the object's size, as of procedural drawers (configs/drawer.yaml); what a scan slides by is not known.
_SLIDE = 0.3
# A camera that is held upright, as configs/profiles/depth_camera.yaml says; 180 stands for any orientation.
_UPRIGHT_DEG = 100

_TEMPLATE = """\
# {category}: {parts} parts, {joint_type} joints, your own scans. Paper size. This file is yours: nothing overwrites it.
# On a CPU:  {cpu_command}
data:
  category: {quoted_category}
  root: {root}
  source: {source}
  view: {view}
  num_points: {points}
  batch_size: 8
model:
  num_parts: {parts}
  joint_type: {joint_type}
  state_range: {state_range:.4f}  # {state_range_note}
{orientation}trainer:
  max_steps: 10000
  default_root_dir: runs/{category}
"""
_POINTS = 512  # that the network reads, as in the paper


def joint_type_of(spec: CategorySpec) -> str:
    """`revolute` or `prismatic`.

    Raises:
        ValueError: if the joints differ, which the network cannot.
    """
    types = {joint.type for joint in spec.joints}
    if len(types) != 1:
        raise ValueError(
            f"category {spec.name!r} has {len(types)} types of joints; a network has joints of one type: write "
            "them all as revolute, or all as prismatic"
        )
    return "revolute" if REVOLUTE in types else "prismatic"


def write_training_config(
    folder: Path, out: Path, source: str, spec: CategorySpec, view: str, points: int
) -> list[str]:
    """Write `config.yaml` into a data set's folder unless it is there, and say how to train with it.

    Args:
        folder: Of the set.
        out: The folder of all sets.
        source: Of the set.
        spec: The category.
        view: `complete` or `partial`.
        points: Stored points of a cloud.

    Returns:
        Lines for the user to read.

    Raises:
        ValueError: if the joints are not of one type.
    """
    joint_type = joint_type_of(spec)
    path = folder / CONFIG_NAME
    own = f"lightning fit -c {shlex.quote(str(path))}"
    on_cpu = f"{own} -c configs/profiles/cpu.yaml"
    if path.exists():
        lines = [f"{path}: kept as it is"]
    else:
        revolute = joint_type == "revolute"
        widest = max(joint.upper - joint.lower for joint in spec.joints) if revolute else _SLIDE
        note = f"{math.degrees(widest):.0f} degrees" if revolute else "share of the object's size"
        upright = f"  orientation_range: {_UPRIGHT_DEG}  # degrees; 180 if the camera was not held upright\n"
        text = _TEMPLATE.format(
            category=spec.name,
            quoted_category=_yaml(spec.name),
            parts=len(spec.parts),
            joint_type=joint_type,
            cpu_command=on_cpu,
            root=_yaml(str(out)),
            source=source,
            view=view,
            points=min(_POINTS, points),
            state_range=widest,
            state_range_note=f"{note}, the most that a joint moves: change it if yours move more",
            orientation=upright if view == "partial" else "",
        )
        with atomic_write(path) as file:
            file.write(text.encode())
        lines = [f"{path}: written; yours to change"]
    return [*lines, f"train with: {own if torch.cuda.is_available() else on_cpu}"]


def _yaml(text: str) -> str:
    """A string that YAML reads back as it is."""
    return "'" + text.replace("'", "''") + "'"
