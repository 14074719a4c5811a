"""The prediction as a moving picture, which web pages, slides and chats play without a viewer."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from articulate_ssl.inference.pictures.picture import moving_figures
from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.ops.progress import announced
from datamodules.atomic import atomic_write

FRAMES = 30  # of all joints together: four seconds, and few enough for 1 MB
WIDTH, HEIGHT = 480, 400  # pixels: two fit side by side into a README
# Inches: what lines and points, whose widths are absolute, are drawn on; chosen by looking at pictures.
FIGURE_WIDTH = 3.6
SUPERSAMPLING = 2  # matplotlib leaves the edges of shaded triangles jagged
MIN_FRAMES_PER_JOINT = 3  # one for each of its ways
SHORTEST_WAY = 1e-12  # a joint without a range has a way of length zero
COLOURS = 256  # as many as a GIF holds
WHITE = (255, 255, 255)
MAX_DRAWN_POINTS = 4096
# For a person to follow; chosen without a measurement. The first frame, which is the prediction, is held.
FRAME_SECONDS, FIRST_SECONDS = 0.08, 0.8

log = logging.getLogger(__name__)


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `moving.gif`: the predicted object, its joints moving one by one, and the scan faintly behind; return it.

    From the predicted state, each joint in turn goes to its upper limit, to its lower one, and back; limits are widened
    to hold that state. The view is that of `picture.png`, with at most `MAX_DRAWN_POINTS` points of the scan, drawn
    with a fixed seed. The picture repeats for ever. It takes some seconds.
    """
    file = folder / "moving.gif"
    drawn = np.random.default_rng(0).permutation(len(result.cloud))[:MAX_DRAWN_POINTS]
    states = torch.from_numpy(_path(result.states, result.limits.numpy()))
    size = FIGURE_WIDTH, FIGURE_WIDTH * HEIGHT / WIDTH
    points, part_id = result.cloud[drawn], result.part_id[drawn]
    figures = moving_figures(result.prediction, points, part_id, result.limits, states, size, result.upright)
    told = announced(log, f"drawing {file.name}", states)
    frames = _of_one_palette([_pixels(figure) for _, figure in zip(told, figures, strict=True)])
    milliseconds = [round(1000 * FIRST_SECONDS)] + [round(1000 * FRAME_SECONDS)] * (len(frames) - 1)
    with atomic_write(file) as opened:
        frames[0].save(
            opened, format="GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, disposal=1
        )
    return [file]


def _path(
    state: np.ndarray,  # [J] where all joints begin and end
    limits: np.ndarray,  # [J, 2]
) -> np.ndarray:  # [F, J], F >= 1; first and last are `state`
    """One joint after the other, in equal times."""
    path = [state[None]]
    for j in range(len(state)):
        low, high = min(limits[j, 0], state[j]), max(limits[j, 1], state[j])
        moving = np.tile(state, (max(MIN_FRAMES_PER_JOINT, (FRAMES - 1) // len(state)), 1))
        moving[:, j] = _sweep(np.array([state[j], high, low, state[j]]), len(moving))
        path.append(moving)
    return np.concatenate(path)


def _sweep(
    stops: np.ndarray,  # [4]
    count: int,  # at least 3
) -> np.ndarray:  # [count] states behind the first stop
    """From stop to stop: slowly away, slowly on, in as many steps as a way's length asks for, but at least one."""
    way = np.abs(np.diff(stops)).cumsum()
    spare = (count - len(way)) * way / max(way[-1], SHORTEST_WAY)
    ends = [0, *np.rint(np.arange(1, len(way)) + spare[:-1]).astype(int), count]
    eased = [(1 - np.cos(np.pi * np.arange(1, steps + 1) / steps)) / 2 for steps in np.diff(ends)]
    ways = zip(pairwise(stops), eased, strict=True)
    return np.concatenate([start + (stop - start) * share for (start, stop), share in ways])


def _pixels(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(SUPERSAMPLING * WIDTH / FIGURE_WIDTH)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3]).resize((WIDTH, HEIGHT), Image.Resampling.BOX)


def _of_one_palette(frames: list[Image.Image]) -> list[Image.Image]:
    """The frames in the colours that suit all of them, so that what stands still does not flicker."""
    strip = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames]))
    strip = strip.quantize(COLOURS, Image.Quantize.MEDIANCUT)
    # What the background shares with near-white pixels is their mean, which would show on a white page.
    palette, background = strip.getpalette(), strip.getpixel((0, 0))
    palette[3 * background : 3 * background + 3] = WHITE
    strip.putpalette(palette)
    return [strip.crop((0, top, WIDTH, top + HEIGHT)) for top in range(0, strip.height, HEIGHT)]
