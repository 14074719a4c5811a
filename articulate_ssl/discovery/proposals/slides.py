"""Sliding parts: pieces that slide alike along one axis of a common frame; cuts cannot part a body from its drawers."""

from __future__ import annotations

from typing import NamedTuple

import torch

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.proposals import Scene, Split
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.slide_table import (
    DEPTHS,
    DIRECTIONS,
    SAME_DEPTH,
    SAME_EXTENT,
    Direction,
    Slides,
    Standing,
    cluster_slides,
    offset_costs,
    place,
)
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

_RESTARTS = 40  # random starts of a clustering


class Stood(NamedTuple):
    """Clouds as they stand for parts that slide along a direction.

    Attributes:
        unit: What becomes one, of clouds of one object; of several objects each has its own.
        fields: Distances to them.
    """

    direction: Direction
    unit: float | None
    fields: DistanceFields

    @staticmethod
    def of(scene: Scene, direction: Direction) -> Stood:
        """The aligned clouds of a scene."""
        unit = float(unit_boxes(scene.aligned)[2].max()) / SAME_EXTENT if scene.same_object else None
        return Stood(direction, unit, DistanceFields.of(Standing.of(scene.aligned, direction, unit).points))


def propose(scene: Scene) -> list[Split]:
    """The best clustering for every direction; none where clouds have no common frame, or joints turn."""
    if not scene.framed or scene.joint_type != PRISMATIC:
        return []
    found = [slid_apart(scene, Stood.of(scene, direction)) for direction in DIRECTIONS]
    return [split for split in found if split is not None]


def slid_apart(scene: Scene, stood: Stood) -> Split | None:
    """The best clustering for a direction; None if a piece has too few points in all."""
    options, template, (direction, unit, fields) = scene.options, scene.template, stood
    own, clouds = Standing.of(template[None], direction, unit), range(len(scene.aligned))
    depths = SAME_DEPTH if scene.same_object else DEPTHS
    table = torch.stack([offset_costs(own.points[0], fields, cloud, direction, depths) for cloud in clouds], dim=1)
    slides = cluster_slides(table, scene.num_parts, options.min_share, _RESTARTS, scene.generator, depths)
    if slides is None:
        return None
    shape = _star(template, slides, direction, float(own.width[0, direction.axis]))
    base, state, log_stretch = (
        value[:, 0] for value in place(shape, scene.aligned, options.points, fields, depths, unit)
    )
    error = torch.full((len(base),), slides.cost).to(template)
    axes = torch.eye(3).to(template).expand(scene.num_parts, 3, 3)
    return Split(slides.label, refined=False, registered=RegisteredShape(shape, base, state, log_stretch, error, axes))


def _star(template: torch.Tensor, slides: Slides, direction: Direction, unit: float) -> ArticulatedShape:
    """The piece that moves least is the root, all others slide on it; at state zero they are where they mostly are."""
    root = int(slides.offset.std(dim=1).argmin())
    children = [part for part in range(len(slides.offset)) if part != root]
    vector = direction.vector(template)
    points = template.clone()
    for part in children:
        middle = (slides.offset[part] - slides.offset[root]).median() * unit
        points[slides.label == part] += middle * vector
    points = points - points.mean(dim=0)
    pivot = torch.stack([points[slides.label == part].mean(dim=0) for part in children])
    chain = KinematicChain(len(slides.offset), root, (root,) * len(children), tuple(children))
    axis = vector.expand(len(children), 3).clone()
    return ArticulatedShape(points, slides.label, Joints(chain, axis, pivot, PRISMATIC))
