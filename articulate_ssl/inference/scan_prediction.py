"""What there is to know about one predicted scan, in its own frame and units: all that exports and viewers read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.articulation import articulate, posed_parts, to_input_frame
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.ops.kd_tree import kd_tree

JOINT_TYPE_NAMES = ("revolute", "prismatic")
UNLIKE = 0.99  # share of the training clouds that are explained better than a scan that is warned of
_BEYOND = 0.2  # of the width of a joint's range, outside it, from which a state is warned of (log, step 264)


@dataclass(frozen=True)
class Part:
    """A rigid part, in the frame and the units of the scan.

    Attributes:
        id: Its number, as in `ScanPrediction.part_id`.
        parent: The part that its joint is on; None of the base.
        pose: [4, 4] canonical space of the part -> scan; column vectors.
        shape: [M, 3] its predicted surface, also where the scan does not see it, posed.
        num_points: Points of the scan that belong to it.
    """

    id: int
    parent: int | None
    pose: np.ndarray
    shape: np.ndarray
    num_points: int


@dataclass(frozen=True)
class Joint:
    """A joint, in the frame and the units of the scan.

    Attributes:
        name: As in `prediction.json` and the exports.
        type: `revolute` or `prismatic`.
        parent: Part that it is fixed to.
        child: Part that it moves.
        axis: [3] unit; a positive revolute state turns counter-clockwise seen from its tip.
        pivot: [3] a point on the joint line.
        state: Radians or a length, relative to the canonical object shape.
        limits: [2] lowest and highest state in training.
    """

    name: str
    type: str
    parent: int
    child: int
    axis: np.ndarray
    pivot: np.ndarray
    state: float
    limits: np.ndarray


@dataclass(frozen=True, repr=False)
class ScanPrediction:
    """A predicted scan; (scan - center) / scale is what the network saw.

    `parts`, `joints`, `articulate`, `to_dict` and `export` give what most users want, as numpy arrays in the frame and
    the units of the scan; the attributes are what these are made of.

    Attributes:
        prediction: B = 1, in the frame and the units of the scan, float64, on the CPU.
        cloud: [M, 3] the whole scan.
        part_id: [M] part of every point of it.
        limits: [J, 2] lowest and highest joint state: radians, or lengths in the units of the scan.
        category: What the network was trained on.
        checkpoint: Path of the weights, or the name of shipped ones; None where no network had a say.
        center: [3], in the frame of the scan.
        scale: Units of the scan per normalised unit.
        rival: The best hypothesis that is turned another way, as `prediction`; None if none was considered.
        probability: That orientation and parts are right, learnt without labels (`inference.confidence`); None if the
            model has not learnt it.
        unlike: Share of the training clouds that were explained better than this scan; None likewise.
        upright: Whether the network was trained on clouds of an upright camera, so that canonical object space tells up
            and front.
    """

    prediction: Prediction
    cloud: np.ndarray
    part_id: np.ndarray
    limits: Tensor
    category: str
    checkpoint: str | None
    center: np.ndarray
    scale: float
    rival: Prediction | None = None
    probability: float | None = None
    unlike: float | None = None
    upright: bool = False

    @property
    def parts(self) -> tuple[Part, ...]:
        """The K parts."""
        prediction = self.prediction
        parent_of = dict(zip(prediction.joint_child[0].tolist(), prediction.joint_parent[0].tolist(), strict=True))
        counts = np.bincount(self.part_id, minlength=prediction.num_parts)
        shapes, poses = self.reconstruction, prediction.part_pose[0].numpy()
        return tuple(Part(k, parent_of.get(k), poses[k], shapes[k], int(counts[k])) for k in range(len(counts)))

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The J = K - 1 joints, in the order of `states`."""
        prediction = self.prediction
        return tuple(
            Joint(
                name=f"joint_{j}",
                type=JOINT_TYPE_NAMES[prediction.joint_type[0, j]],
                parent=int(prediction.joint_parent[0, j]),
                child=int(prediction.joint_child[0, j]),
                axis=prediction.joint_axis[0, j].numpy(),
                pivot=prediction.joint_pivot[0, j].numpy(),
                state=float(prediction.joint_state[0, j]),
                limits=self.limits[j].numpy(),
            )
            for j in range(len(self.limits))
        )

    @property
    def states(self) -> np.ndarray:  # [J]
        """Joint states: radians, or lengths in the units of the scan."""
        return self.prediction.joint_state[0].numpy()

    @property
    def reconstruction(self) -> np.ndarray:  # [K, M, 3]
        """Every part's predicted surface where it is in the scan."""
        return posed_parts(self.prediction)[0].numpy()

    @property
    def relative_error(self) -> float:
        """Reconstruction error over the size of the scan (mean distance of its points to their centre)."""
        size = np.linalg.norm(self.cloud - self.cloud.mean(axis=0), axis=1).mean()
        return float(self.prediction.reconstruction_error[0]) / float(size)

    @property
    def warning(self) -> str:
        """About a scan that is unlike what the network was trained on, "this scan is ..."; empty if nothing is odd."""
        if self.unlike is None:
            return ""
        odd = [f"explained with {joint}, well outside what training showed" for joint in self._joints_beyond()]
        if self.unlike >= UNLIKE:
            odd.append(f"explained worse than {UNLIKE:.0%} of the training clouds")
        if not odd:
            return ""
        return (
            f"{' and '.join(odd)}: it may be another object, cut off, cluttered, or turned, opened or shut as none "
            "was; look before you use it"
        )

    def _joints_beyond(self) -> list[str]:
        """Joints whose states are well outside what training showed, each with its state and that."""
        said = []
        for joint in self.joints:
            low, high = joint.limits
            if max(low - joint.state, joint.state - high) > _BEYOND * (high - low):
                state, *seen = (_measure(joint, x) for x in (joint.state, low, high))
                said.append(f"{joint.name} at {state} (of {' to '.join(seen)})")
        return said

    def articulate(
        self,
        states: Sequence[float] | np.ndarray | Tensor,  # [J], or one number for a single joint
    ) -> np.ndarray:  # [K, M, 3]
        """The object with its joints at `states`, in the frame of the scan; at `self.states`, as it was scanned.

        Raises:
            ValueError: if there is not one finite state for each joint.
        """
        wanted = torch.as_tensor(states, dtype=torch.float64).reshape(-1)
        if len(wanted) != len(self.limits) or not wanted.isfinite().all():
            raise ValueError(f"{len(self.limits)} finite joint states are needed, got {wanted.tolist()}")
        return articulate(self.prediction, wanted)[0].numpy()

    def to_dict(self) -> dict[str, Any]:
        """What `prediction.json` holds, as plain numbers, strings and lists (`inference.export.prediction_json`)."""
        from articulate_ssl.inference.export.prediction_json import describe  # here, because exports import this type

        return describe(self)

    def export(self, folder: str | Path, formats: Sequence[str] | None = None) -> list[Path]:
        """Write the prediction into a folder, made if missing, and return the files.

        Args:
            folder: Where to; files of the same names are replaced.
            formats: Of `inference.export.formats.FORMATS`; None writes all that this machine can
                but `gif`, which takes seconds.

        Raises:
            ExportError: if a format is unknown, or needs a package that is not installed.
            OSError: if a file cannot be written.
        """
        from articulate_ssl.inference.export.folder import exporters_named, write_prediction

        return write_prediction(self, Path(folder), exporters_named(formats))

    def __repr__(self) -> str:
        """One line, without arrays."""
        joints = ", ".join(
            f"{j.name} {j.type} {j.child} on {j.parent} at {_measure(j, j.state, digits=1)}" for j in self.joints
        )
        sure = "" if self.probability is None else f", probability {self.probability:.2f}"
        return f"<ScanPrediction: {self.category}, {len(self.cloud)} points, {joints}{sure}>"


def part_of_points(
    estimate: ScanEstimate,
    cloud: np.ndarray,  # [M, 3] the user's scan, not normalised
) -> np.ndarray:  # [M] part indices
    """Part of every point of the whole scan: that of the nearest point that was labelled."""
    points, part = estimate.points, estimate.prediction.part_id
    if estimate.dense is not None:
        points, part = estimate.dense, estimate.prediction.dense_part_id
    return part[0].cpu().numpy()[kd_tree(points).query((cloud - estimate.center) / estimate.scale)[1]]


def in_scan_frame(
    estimate: ScanEstimate,
    cloud: np.ndarray,  # [M, 3] the user's scan, not normalised
    state_range: Tensor,  # [J, 2] lowest and highest joint state, normalised units
    category: str,
    checkpoint: str | None,
    upright: bool = False,
) -> ScanPrediction:
    """Undo the normalisation, and give every point of the scan its part.

    Raises:
        ValueError: if the prediction holds more than one cloud.
        CheckpointError: if the prediction is not finite.
    """
    prediction, rival, center, scale = estimate.prediction, estimate.rival, estimate.center, estimate.scale
    _check(prediction, checkpoint)
    origin = torch.as_tensor(center, dtype=torch.float64)
    metric = to_input_frame(prediction.to("cpu"), origin, scale)
    prismatic = (metric.joint_type[0] == PRISMATIC)[:, None]
    return ScanPrediction(
        prediction=metric,
        cloud=cloud,
        part_id=part_of_points(estimate, cloud),
        limits=torch.where(prismatic, state_range.cpu().double() * scale, state_range.cpu().double()),
        category=category,
        checkpoint=checkpoint,
        center=center,
        scale=scale,
        rival=None if rival is None else to_input_frame(rival.to("cpu"), origin, scale),
        probability=estimate.probability,
        unlike=estimate.unlike,
        upright=upright,
    )


def _measure(joint: Joint, state: float, digits: int = 0) -> str:
    """A state with its unit: degrees, or a length in the units of the scan."""
    return f"{math.degrees(state):.{digits}f}°" if joint.type == JOINT_TYPE_NAMES[0] else f"{state:.4g}"


def _check(prediction: Prediction, checkpoint: str | None) -> None:
    if len(prediction.part_id) != 1:
        raise ValueError(f"one cloud is exported at a time, got a batch of {len(prediction.part_id)}")
    broken = [f.name for f in fields(prediction) if not getattr(prediction, f.name).isfinite().all()]
    if broken:
        raise CheckpointError(
            f"{checkpoint}: predicts NaN or infinite values ({', '.join(broken)}); its training diverged, train again"
        )
