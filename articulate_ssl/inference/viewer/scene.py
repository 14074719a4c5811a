"""What viewers show of a prediction: the scan, and every hypothesis as coloured meshes on joints that can be moved."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh

from articulate_ssl.inference.articulation import part_motion, posed_parts
from articulate_ssl.inference.export.rigid_links import RigidJoint, rigid_object
from articulate_ssl.inference.pictures.joint_arrow import joint_arrow
from articulate_ssl.inference.pictures.surface import smooth_shaded
from articulate_ssl.inference.pictures.viewpoint import level_frame
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.ops.kd_tree import kd_tree

# Enough to close surfaces on a screen; chosen without a measurement. More make the page slow to open and to turn.
MAX_SHOWN_POINTS = 20_000


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of the scan.

    Attributes:
        title: Such as `best hypothesis`.
        confidence: How sure it is, in words.
        prediction: B = 1, in the frame of the scan.
        part_id: [S] part of every shown point of the scan.
        meshes: Part k's, closed, in canonical object space, vertices parted at sharp edges for smooth shading.
        joints: Types, limits (widened to hold the state) and predicted states.
        arrows: [J, 3, 3] tail, middle, tip, in canonical object space; joint j's moves with its parent part.
    """

    title: str
    confidence: str
    prediction: Prediction
    part_id: np.ndarray
    meshes: tuple[trimesh.Trimesh, ...]
    joints: tuple[RigidJoint, ...]
    arrows: np.ndarray

    def poses(
        self,
        states: list[float],  # J of them, radians or lengths
    ) -> np.ndarray:  # [K, 4, 4] canonical object space -> scan
        """Where the parts' meshes are at `states`: those of `articulation.articulate`."""
        motion = part_motion(self.prediction, torch.tensor(states, dtype=torch.float64))[0]
        return (self.prediction.base_pose[0] @ motion).numpy()


@dataclass(frozen=True)
class Scene:
    """All that is shown, in the frame and the units of the scan.

    Attributes:
        category: What the network was trained on.
        points: [S, 3] at most `MAX_SHOWN_POINTS` points of the scan, chosen with a fixed seed.
        num_points: Of the whole scan.
        center: [3] and
        scale: say that (x - center) / scale is near the origin and about one unit large.
        level: [3, 3] frame of the scan -> (right, up, front), for the first view.
        hypotheses: The best one first.
        warning: About a scan that is unlike what was trained on, or empty.
    """

    category: str
    points: np.ndarray
    num_points: int
    center: np.ndarray
    scale: float
    level: np.ndarray
    hypotheses: tuple[Hypothesis, ...]
    warning: str


def scene_of(result: ScanPrediction) -> Scene:
    """What viewers show of `result`."""
    shown = np.random.default_rng(0).permutation(len(result.cloud))[:MAX_SHOWN_POINTS]
    points = result.cloud[shown]
    found = [_hypothesis(result, "best hypothesis", _confidence(result), result.part_id[shown])]
    if result.rival is not None:
        rival = replace(result, prediction=result.rival)
        found.append(_hypothesis(rival, "rival hypothesis", _rival_confidence(result), _part_of(result.rival, points)))
    to_canonical = result.prediction.base_pose[0, :3, :3].numpy().T
    return Scene(
        category=result.category,
        points=points,
        num_points=len(result.cloud),
        center=np.asarray(result.center, dtype=np.float64),
        scale=float(result.scale),
        level=level_frame(result.prediction, result.limits, result.upright) @ to_canonical,
        hypotheses=tuple(found),
        warning=f"This scan is {result.warning}." if result.warning else "",
    )


def state_text(joint: RigidJoint, state: float) -> str:
    """A state as people read it: degrees, or a length in the unit of the scan."""
    return f"{np.degrees(state):.1f}°" if joint.kind == "revolute" else f"{state:.4g}"


def _hypothesis(result: ScanPrediction, title: str, confidence: str, part_id: np.ndarray) -> Hypothesis:
    thing, prediction = rigid_object(result), result.prediction
    arrows = [joint_arrow(prediction, j) for j in range(len(thing.joints))]
    return Hypothesis(
        title=title,
        confidence=confidence,
        prediction=prediction,
        part_id=part_id,
        meshes=tuple(smooth_shaded(link.mesh) for link in thing.links),
        joints=thing.joints,
        arrows=np.array(arrows).reshape(-1, 3, 3),
    )


def _part_of(
    prediction: Prediction,  # B = 1
    points: np.ndarray,  # [S, 3], same frame
) -> np.ndarray:  # [S]
    """The part whose reconstruction is nearest: a rival labels only the points that the network saw."""
    shapes = posed_parts(prediction)[0].numpy()
    return kd_tree(shapes.reshape(-1, 3)).query(points)[1] // shapes.shape[1]


def _confidence(result: ScanPrediction) -> str:
    if result.probability is not None:
        return f"{result.probability:.0%} sure"
    if result.rival is not None:
        return f"explains the scan {float(result.prediction.margin[0]):.0%} better"
    return "confidence unknown"


def _rival_confidence(result: ScanPrediction) -> str:
    return "less likely" if result.probability is None else f"at most {1 - result.probability:.0%}"
