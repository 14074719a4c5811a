"""A twin of one object, from scans of it in several states: parts, joints, and a prediction for every scan.

No network and no training: `discovery.one_object`. This is the multi-state setting, in which it is known which clouds
show the same object; a category's network never is told.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.one_object.find import OneObject, find_one_object
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.export.formats import ExportError
from articulate_ssl.inference.point_cloud_io import normalise_cloud
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.inference.scan_prediction import ScanPrediction, in_scan_frame
from articulate_ssl.ops.chamfer import chamfer
from articulate_ssl.ops.denormals import flush_denormals
from datamodules.atomic import atomic_write

CATEGORY = "twin"  # what predictions and exports call an object that is its own category
STATES_FILE = "states.json"
_POINTS = 4096  # of every scan, at most, that are read
_JOINT_TYPES = {"revolute": REVOLUTE, "prismatic": PRISMATIC}


@dataclass(frozen=True)
class Twin:
    """One object as its scans show it.

    Attributes:
        scans: One prediction per scan, each in the frame of its scan; parts, canonical shapes and joints are the same
            in all, states and poses differ. `limits` are the lowest and highest state that any scan shows.
        misfit: Median distance of the scans from one another, each part moved as found, over the size of the object.
        unexplained: Share of the points that are off whichever part they are moved with (`OneObject.unexplained`).
    """

    scans: tuple[ScanPrediction, ...]
    misfit: float
    unexplained: float

    @property
    def states(self) -> np.ndarray:
        """[n, J] joint states of every scan: radians, or lengths in the units of the scans."""
        return torch.cat([scan.prediction.joint_state for scan in self.scans]).numpy()

    def export(
        self,
        folder: str | os.PathLike,
        names: Sequence[str],
        scan: int = 0,
        formats: Sequence[str] | None = None,
    ) -> list[Path]:
        """Write the object as one scan shows it (`ScanPrediction.export`), and `states.json`, the states of all.

        Args:
            folder: Is made if missing.
            names: What the scans are called, each otherwise.
            scan: The one that is exported.
            formats: As `ScanPrediction.export`.

        Returns:
            The files written.

        Raises:
            ExportError: if two scans have one name, or if a format is unknown or needs a package that is not installed.
            ValueError: if there is not one name for each scan.
            OSError: if a file cannot be written.
        """
        folder, repeated = Path(folder), [name for name, times in Counter(names).items() if times > 1]
        if repeated:
            raise ExportError(
                f"{len(names)} scans, of which several are called {', '.join(repeated)}: {STATES_FILE} could hold the "
                "state of one of them only; give each a name of its own"
            )
        content = {
            name: {"state": one.prediction.joint_state[0].tolist(), "base_pose": one.prediction.base_pose[0].tolist()}
            for name, one in zip(names, self.scans, strict=True)
        }
        files = self.scans[scan].export(folder, formats)
        file = folder / STATES_FILE
        with atomic_write(file) as opened:
            opened.write((json.dumps(content, indent=2) + "\n").encode())
        return [*files, file]


def find_twin(
    clouds: Sequence[np.ndarray],  # each [M, 3]: complete scans of one object, any orientation and origin, one unit
    num_parts: int,
    joint: str = "revolute",
    seed: int = 0,
) -> Twin:
    """Parts and joints of one object from eight or more complete scans of it in different states.

    About a minute of one core for twelve scans. All joints are of one type.

    Args:
        num_parts: How many parts move on their own, the base included.
        joint: `revolute` or `prismatic`.
        seed: Of everything random.

    Raises:
        ValueError: for an unknown type of joint, or fewer than two parts.
        DiscoveryError: if there are too few scans, or they do not show so many moving parts.
    """
    if joint not in _JOINT_TYPES:
        raise ValueError(f"joint must be one of {sorted(_JOINT_TYPES)}, got {joint!r}")
    if num_parts < 2:
        raise ValueError(f"num_parts must be at least 2, got {num_parts}")
    scale = float(np.median([normalise_cloud(cloud, 1)[2] for cloud in clouds])) if len(clouds) else 1.0
    # As many of each, and none twice, which would have no normal.
    count = min([_POINTS, *map(len, clouds)])
    read = [normalise_cloud(cloud, count, scale=scale) for cloud in clouds]
    points = torch.from_numpy(np.stack([one for one, _, _ in read])) if read else torch.zeros(0, count, 3)
    with flush_denormals():
        found = find_one_object(points, num_parts, _JOINT_TYPES[joint], seed=seed, labelled=count)
    scans = tuple(_scan(found, i, points[i], cloud, read[i][1], scale) for i, cloud in enumerate(clouds))
    return Twin(scans, float(found.misfit.median()), found.unexplained)


def _scan(
    found: OneObject,
    i: int,
    points: Tensor,  # [N, 3] normalised
    cloud: np.ndarray,  # [M, 3]
    center: np.ndarray,  # [3]
    scale: float,
) -> ScanPrediction:
    labelled = points[: found.label.shape[1]].numpy()
    estimate = ScanEstimate(_prediction(found, i, points), None, labelled, center, scale)
    cloud = np.asarray(cloud, dtype=np.float64)
    return in_scan_frame(estimate, cloud, found.shape.joints.limits, CATEGORY, None)


def _prediction(
    found: OneObject,
    i: int,
    points: Tensor,  # [N, 3] normalised
) -> Prediction:
    """The object in cloud i, B = 1, normalised units."""
    shape, joints = found.shape, found.shape.joints
    base, state = found.base[i : i + 1], found.state[i : i + 1]
    pose = joints.part_pose(base, state)
    canonical = torch.stack([shape.part(part) for part in range(shape.num_parts)])  # [K, M, 3]
    assembly = canonical.mean(dim=1)
    parent, child = torch.tensor(joints.chain.parent), torch.tensor(joints.chain.child)
    parent_pose = pose[:, parent]
    posed = transform_points(pose, canonical[None])
    return Prediction(
        part_id=found.label[i : i + 1],
        part_probability=found.probability[i : i + 1],
        part_pose=pose @ se3(torch.eye(3).to(assembly).expand(len(assembly), 3, 3), assembly),
        part_shape=(canonical - assembly[:, None])[None],
        assembly=assembly[None],
        base_pose=base,
        joint_parent=parent[None],
        joint_child=child[None],
        joint_type=torch.full((1, len(parent)), joints.joint_type),
        joint_axis=(parent_pose[..., :3, :3] @ joints.axis[None, ..., None]).squeeze(-1),
        joint_pivot=transform_points(parent_pose, joints.pivot[None, :, None])[:, :, 0],
        joint_state=state,
        canonical_axis=joints.axis[None],
        canonical_pivot=joints.pivot[None],
        reconstruction_error=chamfer(points[None].double(), posed.flatten(1, 2)),
        margin=torch.ones(1, dtype=torch.float64),
    )
