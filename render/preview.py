"""The program behind `make preview`: a contact sheet of a category.

Instances in their rest state, how they move between the ends of the articulation range, and what a depth camera sees of
them, with joint axes drawn: `python -m render.preview --category laptop --out build/preview`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from articulate_ssl.geometry.screw import REVOLUTE
from render.arguments import at_least
from render.articulated_object import ArticulatedObject
from render.category import CategorySpec, category_names, load_category
from render.depth_renderer import RendererUnavailable
from render.partial_cloud import DepthSensor
from render.posing import compose, sample_states
from render.seeds import generator_for
from render.shaded_picture import PART_COLORS, Viewpoint, frame, posed_vertices, shaded_picture
from render.sources import SOURCES, left_out_lines, open_source

COLUMNS = 6
_TILE = 240  # pixels
_CLOUD_POINTS = 2048
_UPRIGHT = np.diag([1.0, -1.0, -1.0])  # camera frame -> a frame with y up that is seen from its +z side
_AXIS_COLOR = "#c2002f"


def contact_sheet(spec: CategorySpec, instances: list[ArticulatedObject], seed: int) -> Figure:
    """The sheet: two rows of rest states, one of joint states, one of partial clouds.

    Args:
        spec: The category.
        instances: At least one instance, in the category's rest state.
        seed: Of states and views of the partial clouds.

    Raises:
        RendererUnavailable: if there is no working EGL.
        ValueError: if no view shows every part of an instance.
    """
    rest_rows = -(-min(len(instances), 2 * COLUMNS) // COLUMNS)
    rows = rest_rows + 2
    figure = Figure(figsize=(COLUMNS * _TILE / 100, rows * (_TILE + 16) / 100), dpi=100)
    grid = figure.subplots(rows, COLUMNS, squeeze=False)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1 - 16 / (rows * (_TILE + 16)), wspace=0, hspace=16 / _TILE)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, instance in zip(grid[:rest_rows].ravel(), instances, strict=False):
        _draw_rest(axes, instance)
    for first in range(0, COLUMNS, 3):
        instance = instances[(first // 3) % len(instances)]
        _draw_states(grid[rest_rows, first : first + 3], spec, instance)
    for column, axes in enumerate(grid[rest_rows + 1]):
        instance = instances[column % len(instances)]
        _draw_partial_cloud(axes, spec, instance, generator_for(seed, "preview", instance.name, column))
    return figure


def _draw_rest(axes: Axes, instance: ArticulatedObject) -> None:
    states = np.array([joint.rest for joint in instance.joints])
    picture = shaded_picture(instance, states, frame(posed_vertices(instance, states)), _TILE)
    _show(axes, picture, instance.name)


def _draw_states(row: np.ndarray, spec: CategorySpec, instance: ArticulatedObject) -> None:
    """Lower end, middle and upper end of the articulation range, in one framing."""
    lower, upper = np.array(spec.sampled_ranges(instance)).T
    stages = [lower, (lower + upper) / 2, upper]
    viewpoint = frame(np.concatenate([posed_vertices(instance, states) for states in stages]))
    for axes, states in zip(row, stages, strict=True):
        _show(axes, shaded_picture(instance, states, viewpoint, _TILE), _state_text(instance, states))
        _draw_axes(axes, instance, instance.part_motion(states), viewpoint)


def _draw_partial_cloud(axes: Axes, spec: CategorySpec, instance: ArticulatedObject, rng: np.random.Generator) -> None:
    states = sample_states(spec.sampled_ranges(instance), 1, rng)[0]
    sensor = DepthSensor(
        instance,
        spec.view,
        renderer="egl",
        protocol="honest",
        resolution=spec.view.resolution,
        num_points=_CLOUD_POINTS,
        min_visible_points=spec.min_visible_points,
        noise_std=0.0,
    )
    motion = instance.part_motion(states)
    cloud = sensor.observe(motion, rng)
    # Shown from a little beside the sensor, so that one sees what it did not.
    aside = frame(cloud.points @ _UPRIGHT, azimuth=np.deg2rad(18.0), elevation=np.deg2rad(12.0))
    viewpoint = Viewpoint(aside.rotation @ _UPRIGHT, aside.translation)
    order = np.argsort(-(cloud.points @ viewpoint.rotation[2]))
    colors = PART_COLORS[cloud.part_id[order] % len(PART_COLORS)]
    axes.scatter(*viewpoint.project(cloud.points[order]).T, s=2.6, c=colors, linewidths=0)
    axes.set_title(_state_text(instance, states), fontsize=7, pad=2)
    _draw_axes(axes, instance, compose(cloud.rotation, cloud.translation, motion), viewpoint)


def _show(axes: Axes, picture: np.ndarray, title: str) -> None:
    axes.imshow(picture, extent=(-1, 1, 1, -1), interpolation="none")
    axes.set_title(title, fontsize=7, pad=2)


def _state_text(instance: ArticulatedObject, states: np.ndarray) -> str:
    pairs = zip(instance.joints, states, strict=True)
    return ", ".join(f"{np.rad2deg(q):.0f}°" if j.type == REVOLUTE else f"{100 * q:.0f} cm" for j, q in pairs)


def _draw_axes(
    axes: Axes,
    instance: ArticulatedObject,
    pose: np.ndarray,  # [K, 4, 4] of the parts, in the frame that the viewpoint looks at
    viewpoint: Viewpoint,
) -> None:
    """Hinge lines beside the part they move; for sliding joints an arrow from the part's pivot."""
    reach = 0.22 * instance.rest_diagonal
    for joint in instance.joints:
        rotation, translation = pose[joint.child, :3, :3], pose[joint.child, :3, 3]
        start = end = joint.pivot
        if joint.type == REVOLUTE:
            middle = joint.pivot + joint.axis * (
                joint.axis @ (instance.meshes[joint.child].bounds.mean(0) - joint.pivot)
            )
            start = middle - reach * joint.axis
        end = start + (2 * reach if joint.type == REVOLUTE else reach) * joint.axis
        tail, head = viewpoint.project(np.stack([start, end]) @ rotation.T + translation)
        axes.annotate(
            "", head, tail, arrowprops={"arrowstyle": "->", "color": _AXIS_COLOR, "lw": 1.4}, annotation_clip=False
        )
    axes.set(xlim=(-1, 1), ylim=(1, -1), aspect="equal")


def _save(figure: Figure, path: Path) -> None:
    """Write a PNG with a palette: a third of the size of true colour."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    picture.quantize(256, Image.Quantize.MEDIANCUT).save(path, optimize=True)


def main(argv: list[str] | None = None) -> int:
    """Command line; 2 with one message on stderr for bad input and where EGL is missing."""
    parser = argparse.ArgumentParser(
        prog="python -m render.preview",
        description="Draw a contact sheet of a category.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--category", required=True, choices=category_names())
    parser.add_argument("--source", default="procedural", choices=tuple(SOURCES))
    parser.add_argument("--root", type=Path, help="folder of an external source's data set")
    parser.add_argument("--variant", help="of the category's procedural designs")
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--out", type=Path, default=Path("build/preview"), help="folder")
    arguments = parser.parse_args(argv)
    variant = f"-{arguments.variant}" if arguments.variant else ""
    path = arguments.out / f"{arguments.category}-{arguments.source}{variant}.png"
    try:
        spec = load_category(arguments.category, arguments.variant)
        source = open_source(arguments.source, spec, arguments.root, arguments.seed)
        ids = source.instance_ids()[: 2 * COLUMNS]
        for line in left_out_lines(source.left_out()):
            print(line, file=sys.stderr)
        instances = [spec.to_rest(source.load(instance_id)) for instance_id in ids]
        figure = contact_sheet(spec, instances, arguments.seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        _save(figure, path)
    except (ValueError, OSError, RendererUnavailable) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
