"""Pictures of a prediction, drawn with matplotlib alone: no display, no OpenGL. Scans are points, objects surfaces."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import TriMesh
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from matplotlib.tri import Triangulation
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import invert_se3
from articulate_ssl.inference.articulation import canonical_object, part_motion, to_canonical
from articulate_ssl.inference.export.part_mesh import part_mesh
from articulate_ssl.inference.pictures.joint_arrow import joint_arrow
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.pictures.surface import LitTriangles, Surface, cut_small, lit_triangles
from articulate_ssl.inference.pictures.viewpoint import viewing_rotation
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.ops.kd_tree import kd_tree
from datamodules.atomic import atomic_write

PANEL_INCHES = 2.6
INK = "#222222"
LIGHT = np.array([-0.36, 0.6, 0.71])
# Share of their colour that points keep which a moving object leaves behind; chosen by looking at pictures.
FAINT = 0.3
MARGIN = 0.02  # of a moving picture, as a share of its size: discs and arrowheads reach beyond their points


@dataclass(frozen=True)
class SampleRow:
    """One row of `draw_test_samples`.

    Attributes:
        title: What the sample is and how well it went, such as "median: R 3.1 deg".
        points: [N, 3] the input, camera space.
        prediction: Its prediction, B = 1, on the same points.
        true_part: [N] ground-truth parts, numbered as the prediction numbers them, or None.
        upright: Whether the network was trained on clouds of an upright camera (see `viewpoint.level_frame`).
    """

    title: str
    points: np.ndarray
    prediction: Prediction
    true_part: np.ndarray | None = None
    upright: bool = False


def draw_prediction(
    prediction: Prediction,  # B = 1
    points: np.ndarray,  # [N, 3] the cloud, camera space
    part_id: np.ndarray,  # [N] predicted part of every point
    state_range: Tensor,  # [J, 2] lowest and highest joint state
    upright: bool,
    path: str | os.PathLike,
) -> None:
    """Write the picture of `prediction_figure` as PNG, whole or not at all."""
    _save(prediction_figure(prediction, points, part_id, state_range, upright), path)


def draw_test_samples(rows: Sequence[SampleRow], path: str | os.PathLike) -> None:
    """Write the picture of `samples_figure` as PNG, whole or not at all."""
    _save(samples_figure(rows), path)


def prediction_figure(
    prediction: Prediction,  # B = 1
    points: np.ndarray,  # [N, 3]
    part_id: np.ndarray,  # [N]
    state_range: Tensor,  # [J, 2]
    upright: bool = False,
) -> Figure:
    """Six panels: input by part, reconstruction, canonical object with its joints, and three articulation states.

    The states are the ends and the middle of `state_range`, as in the paper's manipulation figure; an object without
    joints has the first three panels only. The predicted base pose is undone, and all panels share one view and scale.
    `upright` says that the network was trained on clouds of an upright camera (see `viewpoint.level_frame`).
    """
    prediction = prediction.to("cpu")
    state_range = state_range.to(prediction.joint_state)
    motions = [
        ("Reconstruction", _predicted_motion(prediction)),
        ("Canonical object and joints", part_motion(prediction, torch.zeros_like(prediction.joint_state))[0]),
    ]
    for share in (0.0, 0.5, 1.0) if len(state_range) else ():
        states = torch.lerp(state_range[:, 0], state_range[:, 1], share)
        motions.append((f"Articulated to {_state_text(prediction, states)}", part_motion(prediction, states)[0]))

    view = viewing_rotation(prediction, state_range, upright)
    cloud = _seen(prediction, torch.as_tensor(points), view)
    surfaces = _surfaces(prediction, cloud)
    drawings = [lit_triangles(surfaces, _seen_pose(motion, view)) for _, motion in motions]
    arrows = [joint_arrow(prediction, j) @ view.T for j in range(len(state_range))]
    window = _window([cloud, *arrows, *(drawing.corners.reshape(-1, 2) for drawing in drawings)])
    figure, axes = _grid([window], len(motions) + 1)
    _draw_cloud(axes[0, 0], cloud, part_id, window)
    axes[0, 0].set_title("Input, by predicted part", fontsize=9, color=INK)
    for ax, (title, _), drawing in zip(axes[0, 1:], motions, drawings, strict=True):
        _draw_surfaces(ax, drawing, window)
        ax.set_title(title, fontsize=9, color=INK)
    for arrow in arrows:
        _draw_arrow(axes[0, 2], arrow)
    return figure


def samples_figure(rows: Sequence[SampleRow]) -> Figure:
    """A row per sample: input by ground-truth part (grey if unknown), by predicted part, and the reconstruction."""
    clouds, drawings, windows = [], [], []
    for row in rows:
        prediction = row.prediction.to("cpu")
        view = viewing_rotation(prediction, prediction.joint_state[0, :, None].expand(-1, 2), row.upright)
        clouds.append(_seen(prediction, torch.as_tensor(row.points), view))
        drawings.append(
            lit_triangles(_surfaces(prediction, clouds[-1]), _seen_pose(_predicted_motion(prediction), view))
        )
        windows.append(_window([clouds[-1], drawings[-1].corners.reshape(-1, 2)]))

    figure, axes = _grid(windows, 3)
    for row, row_axes, cloud, drawing, window in zip(rows, axes, clouds, drawings, windows, strict=True):
        truth = np.full(len(row.points), -1) if row.true_part is None else row.true_part
        _draw_cloud(row_axes[0], cloud, truth, window)
        _draw_cloud(row_axes[1], cloud, row.prediction.part_id[0].cpu().numpy(), window)
        _draw_surfaces(row_axes[2], drawing, window)
        row_axes[0].set_title(row.title, fontsize=9, color=INK, loc="left", fontweight="bold")
    heading = "Input" if all(r.true_part is None for r in rows) else "Input, by true part"
    for ax, text in zip(axes[-1], (heading, "By predicted part", "Reconstruction"), strict=True):
        ax.text(0.5, -0.02, text, transform=ax.transAxes, ha="center", va="top", fontsize=9, color=INK)
    return figure


def moving_figures(
    prediction: Prediction,  # B = 1
    points: np.ndarray,  # [N, 3]
    part_id: np.ndarray,  # [N]
    state_range: Tensor,  # [J, 2] as of `prediction_figure`
    states: Tensor,  # [F, J]
    size: tuple[float, float],  # inches: width, height
    upright: bool = False,
) -> Iterator[Figure]:
    """The object and its joints in one set of states after the other, and the scan faintly behind where it was.

    All F figures are of the same size, and share one scale and the view of `prediction_figure`.
    """
    prediction = prediction.to("cpu")
    view = viewing_rotation(prediction, state_range.to(prediction.joint_state), upright)
    cloud = _seen(prediction, torch.as_tensor(points), view)
    surfaces = _surfaces(prediction, cloud)
    poses = [_seen_pose(part_motion(prediction, one)[0], view) for one in states]
    drawings = [lit_triangles(surfaces, pose) for pose in poses]
    arrows = [_seen_arrows(prediction, pose) for pose in poses]
    shapes = [cloud, *(arrow for of_one in arrows for arrow in of_one)]
    window = _window(shapes + [drawing.corners.reshape(-1, 2) for drawing in drawings])
    for drawing, of_one in zip(drawings, arrows, strict=True):
        figure = Figure(figsize=size)
        ax = figure.add_axes((MARGIN, MARGIN, 1 - 2 * MARGIN, 1 - 2 * MARGIN))
        _draw_cloud(ax, cloud, part_id, window, FAINT)
        _draw_surfaces(ax, drawing, window)
        for arrow in of_one:
            _draw_arrow(ax, arrow)
        yield figure


def _seen_arrows(
    prediction: Prediction,
    poses: np.ndarray,  # [K, 4, 4] canonical object space -> right, up, towards the viewer
) -> list[np.ndarray]:  # [J] of [3, 3] tail, middle, tip
    """Those of the joints, each on the part that it is fixed to."""
    parents = prediction.joint_parent[0].tolist()
    return [joint_arrow(prediction, j) @ poses[k, :3, :3].T + poses[k, :3, 3] for j, k in enumerate(parents)]


def _predicted_motion(prediction: Prediction) -> Tensor:  # [K, 4, 4] float64
    """Motion of every part in canonical object space as its pose has it, whether or not it obeys the joints."""
    apart = torch.eye(4, dtype=torch.float64).repeat(prediction.num_parts, 1, 1)
    apart[:, :3, 3] = -prediction.assembly[0].double()
    return invert_se3(prediction.base_pose[0].double()) @ prediction.part_pose[0].double() @ apart


def _surfaces(
    prediction: Prediction,
    cloud: np.ndarray,  # [N, 3] beside which they are drawn
) -> list[Surface]:
    """Those of the parts, in canonical object space."""
    meshes = [part_mesh(shape) for shape in canonical_object(prediction)[0].double().numpy()]
    return cut_small(meshes, float(np.ptp(cloud, axis=0).max()))


def _seen_pose(
    motion: Tensor,  # [K, 4, 4] canonical object space -> itself
    view: np.ndarray,  # [3, 3]
) -> np.ndarray:  # [K, 4, 4] canonical object space -> right, up, towards the viewer
    turn = np.eye(4)
    turn[:3, :3] = view
    return turn @ motion.double().numpy()


def _window(shapes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Centre [2] and half size [2] of the rectangle that holds all projected shapes."""
    flat = np.concatenate([shape[:, :2] for shape in shapes])
    low, high = flat.min(axis=0), flat.max(axis=0)
    half = 0.53 * (high - low)
    return (low + high) / 2, np.maximum(half, max(0.4 * half.max(), 1e-9))


def _grid(windows: Sequence[tuple[np.ndarray, np.ndarray]], columns: int) -> tuple[Figure, np.ndarray]:
    """A figure with one row of panels per window, as high as its window asks for."""
    heights = [PANEL_INCHES * half[1] / half[0] for _, half in windows]
    size = (columns * (PANEL_INCHES + 0.1), sum(heights) + 0.4 * len(heights))
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    return figure, figure.subplots(len(windows), columns, squeeze=False, height_ratios=heights)


def _draw_cloud(
    ax: Axes,
    shape: np.ndarray,  # [N, 3] right, up, towards the viewer
    part_id: np.ndarray,  # [N], -1 is grey
    window: tuple[np.ndarray, np.ndarray],
    strength: float = 1.0,
) -> None:
    """Points as lit discs that just close up, far ones first and paler; of a `strength` below one all are paler."""
    brightness, spacing = np.ones(len(shape)), np.zeros(len(shape))
    for part in np.unique(part_id):
        of_part = part_id == part
        brightness[of_part], spacing[of_part] = _lambert(shape[of_part])
    depth = (shape[:, 2] - shape[:, 2].min()) / max(np.ptp(shape[:, 2]), 1e-12)
    colour = np.where(part_id[:, None] < 0, 150, part_colour(part_id)) / 255 * brightness[:, None]
    colour = 1 - (0.7 + 0.3 * depth[:, None]) * (1 - colour)
    diameter = np.clip(2.0 * spacing * PANEL_INCHES * 72 / (2 * window[1][0]), 1.2, 9.0)
    order = np.argsort(shape[:, 2])
    colour = colour[order]
    inside, edge = 1 - strength * (1 - colour), 1 - strength * (1 - 0.7 * colour)
    ax.scatter(*shape[order, :2].T, s=diameter[order] ** 2, c=inside, linewidths=0.2, edgecolors=edge)
    _show_window(ax, window)


def _draw_surfaces(
    ax: Axes,
    triangles: LitTriangles,
    window: tuple[np.ndarray, np.ndarray],
) -> None:
    corners, colours = triangles.corners.reshape(-1, 2), np.repeat(triangles.colour, 3, axis=0)
    mesh = TriMesh(Triangulation(*corners.T, np.arange(len(corners)).reshape(-1, 3)))
    mesh.set_facecolor(colours)
    ax.add_collection(mesh)
    _show_window(ax, window)


def _show_window(ax: Axes, window: tuple[np.ndarray, np.ndarray]) -> None:
    center, half = window
    ax.set_xlim(center[0] - half[0], center[0] + half[0])
    ax.set_ylim(center[1] - half[1], center[1] + half[1])
    ax.set_aspect("equal")
    ax.axis("off")


def _lambert(
    shape: np.ndarray,  # [N, 3] one part
) -> tuple[np.ndarray, float]:
    """Brightness [N] of the points' local planes in light from the upper left, both sides alike; and point spacing."""
    distance, index = kd_tree(shape).query(shape, k=range(1, min(16, len(shape)) + 1))
    spread = shape[index] - shape[index].mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    normal = np.where(normal[:, 2:] < 0, -normal, normal)
    return 0.68 + 0.32 * np.clip(normal @ LIGHT, 0, 1), float(np.median(distance[:, -1]) / np.sqrt(len(index[0])))


def _draw_arrow(ax: Axes, arrow: np.ndarray) -> None:
    style = dict(arrowstyle="-|>,head_width=0.25,head_length=0.5", color=INK, linewidth=1.6, shrinkA=0, shrinkB=0)
    halo = [Stroke(linewidth=3.6, foreground="white"), Normal()]
    ax.annotate("", xy=arrow[2, :2], xytext=arrow[0, :2], arrowprops=style | {"path_effects": halo}, zorder=3)
    ax.plot(*arrow[1, :2], "o", color="white", markeredgecolor=INK, markersize=4.5, zorder=4)


def _state_text(prediction: Prediction, states: Tensor) -> str:
    texts = [
        f"{state:.2g}" if kind == PRISMATIC else f"{np.degrees(state):.0f}°"
        for state, kind in zip(states.tolist(), prediction.joint_type[0].tolist(), strict=True)
    ]
    return ", ".join(texts if len(set(texts)) > 1 else texts[:1]).replace("-", "\N{MINUS SIGN}")


def _seen(
    prediction: Prediction,
    cloud: Tensor,  # [..., 3] camera space
    view: np.ndarray,  # [3, 3]
) -> np.ndarray:  # [N, 3] right, up, towards the viewer
    return to_canonical(prediction, cloud).reshape(-1, 3).numpy() @ view.T


def _save(figure: Figure, path: str | os.PathLike) -> None:
    with atomic_write(path) as file:
        figure.savefig(file, format="png", facecolor="white")
