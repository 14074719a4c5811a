"""What a part's features are worth: do they stay while another part moves? (paper, "Part-Level Equivariant Features")

Features of the first iteration are equivariant to motions of the whole cloud, and change wherever a convolution reaches
across a joint. From the second iteration on points are read in the estimated frames of their parts (pose-aware
convolution), and should not. So a cloud is articulated by its labels, every point with its part, and the features of
the part that stays are compared, point by point, with those before.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.pictures.viewpoint import three_quarter_view
from articulate_ssl.losses.reconstruction import distances_to_parts
from articulate_ssl.network.articulated_network import in_part_frames
from articulate_ssl.training.module import ArticulatedPoseModule
from datamodules.atomic import atomic_write

NAMES = ("first iteration: of the whole cloud", "second iteration: part-level")
STEPS = 7  # states of the moving part, from the lowest to the highest in training
DRAWN = (0, 2, 4, 6)  # of them, in the picture
_GREY = 0.85


@dataclass(frozen=True)
class PartFeatures:
    """Of clouds in several states of their first joint.

    Attributes:
        stays: [B, C] whether the point is of the part that the joint moves the others on.
        features: Of either kind [B, S, C, D].
        states: [B, S] of the joint.
        shown: [S, M, 3] the first cloud in every state, x right, y up, z towards the viewer.
        nearest: [M] of its C points with features the nearest of the same part, whose colour they get in the picture;
            -1 for points that do not stay.
    """

    stays: Tensor
    features: tuple[Tensor, Tensor]
    states: Tensor
    shown: Tensor
    nearest: Tensor

    def change(
        self,
        kind: int,
    ) -> Tensor:  # [B, S]
        """Of the staying part's features, from those in the middle state: squared, over their variance in a cloud.

        0 where nothing changes; 2 where features of a point say no more of it than another point's.
        """
        features, middle = self.features[kind], self.features[kind][:, STEPS // 2, None]
        kept = self.stays[:, None, :, None].to(features)
        count = kept.sum(dim=2).clamp(min=1)
        mean = (middle * kept).sum(dim=2) / count
        variance = ((middle - mean[:, :, None]).square() * kept).sum(dim=2) / count
        moved = ((features - middle).square() * kept).sum(dim=2) / count
        return moved.sum(dim=-1) / variance.sum(dim=-1)


@torch.no_grad()
def measure(
    module: ArticulatedPoseModule,
    batch: dict[str, Tensor],
) -> PartFeatures:
    """Features of the clouds of a labelled batch, each in `STEPS` states of its first joint.

    Raises:
        ValueError: if the module does not estimate poses twice.
    """
    estimator, network = module.estimator, module.articulated
    if estimator.iterations < 2:
        raise ValueError("these weights estimate poses once; part-level features are those of a second iteration")
    count = batch["points"].shape[1]
    state, child = batch["joint_state"][:, 0], batch["joint_child"][0, 0]
    kind, parent = int(batch["joint_type"][0, 0]), batch["joint_parent"][0, 0]
    low, high = state.min(), state.max()
    states = torch.linspace(0, 1, STEPS)[None] * (high - low) + low
    states = states.expand(len(state), STEPS)
    axis, pivot = (batch[name][:, 0, None].expand(-1, STEPS, -1) for name in ("joint_axis", "joint_pivot"))
    motion = screw_motion(axis, pivot, states - state[:, None], kind)  # [B, S, 4, 4]
    part = batch["dense_part_id"]
    points = batch["dense_points"][:, None].expand(-1, STEPS, -1, -1)
    moved = torch.where((part == child)[:, None, :, None], transform_points(motion, points), points)
    # The second kind reads every cloud in the frames that the first estimate gave it, as in training and at test time.
    clouds = moved[:, :, :count].flatten(0, 1)
    aligned, _ = estimator.align(clouds)
    first, *_ = estimator.iterate(aligned)
    estimate = first.hypotheses.select(first.winner)
    labels = distances_to_parts(aligned, estimate.posed()[:, 0]).argmin(dim=-1)
    kinds = (network.point_features(aligned), network.point_features(in_part_frames(aligned, estimate, labels)))
    features = tuple(own.unflatten(0, (-1, STEPS)) for own in kinds)
    stays = part == parent
    view = torch.from_numpy(three_quarter_view()).to(moved) @ batch["object_rotation"][0].mT
    deep = features[0].shape[2]
    distance = torch.cdist(points[0, 0], points[0, 0, :deep]).masked_fill(~stays[0, :deep], torch.inf)
    nearest = distance.argmin(dim=1).masked_fill(~stays[0], -1)
    return PartFeatures(stays[:, :deep], features, states, moved[0] @ view.mT, nearest)


def write(found: PartFeatures, joint_type: int, title: str, folder: Path) -> list[Path]:
    """`part_features.csv`, how features change with the joint's motion, and `part_features.png`, the first cloud's."""
    unit = math.degrees(1) if joint_type == REVOLUTE else 1.0
    motion = (unit * (found.states - found.states[:, STEPS // 2, None]))[0]
    changes = [found.change(kind).median(dim=0).values for kind in range(len(NAMES))]
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["joint_motion", *NAMES])
    writer.writerows([float(at), *(float(change[i]) for change in changes)] for i, at in enumerate(motion))
    with atomic_write(folder / "part_features.csv") as file:
        file.write(table.getvalue().encode())
    with atomic_write(folder / "part_features.png") as file:
        _drawn(found, motion, changes, joint_type == REVOLUTE, title).savefig(file, format="png")
    return [folder / "part_features.csv", folder / "part_features.png"]


def _drawn(found: PartFeatures, motion: Tensor, changes: list[Tensor], turns: bool, title: str) -> Figure:
    figure = Figure(figsize=(13, 4.8), dpi=120, layout="constrained")
    grid = figure.add_gridspec(2, len(DRAWN) + 2)
    for kind, name in enumerate(NAMES):
        colours = _colours(found.features[kind][0], found.stays[0])
        for column, state in enumerate(DRAWN):
            axes = figure.add_subplot(grid[kind, column])
            shades = np.where(found.nearest[:, None] < 0, _GREY, colours[state][found.nearest])
            _scatter(axes, found.shown[state].numpy(), shades)
            axes.set_title(name if not column else "", loc="left")
    axes = figure.add_subplot(grid[:, len(DRAWN) :])
    for change, name, mark in zip(changes, NAMES, ("o-", "s-"), strict=True):
        axes.plot(motion, change, mark, label=name)
    axes.set(
        xlabel=f"motion of the other part ({'degrees' if turns else 'normalised length'})",
        title="change of the features of the part that stays\n(squared, over their variance within a cloud)",
    )
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.suptitle(title)
    return figure


def _scatter(axes: Axes, points: np.ndarray, colours: np.ndarray) -> None:
    order = points[:, 2].argsort()
    axes.scatter(*points[order, :2].T, c=colours[order], s=4, linewidths=0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _colours(
    features: Tensor,  # [S, C, D]
    stays: Tensor,  # [C]
) -> np.ndarray:  # [S, C, 3]
    """The three directions in which the staying part's features vary most, in all states, as RGB."""
    own = features[:, stays].flatten(0, 1)
    mean = own.mean(dim=0)
    _, _, directions = torch.linalg.svd(own - mean, full_matrices=False)
    values = (features - mean) @ directions[:3].T
    low, high = torch.quantile(values[:, stays].flatten(0, 1), torch.tensor([0.02, 0.98]), dim=0)
    return ((values - low) / (high - low)).clamp(0, 1).numpy()
