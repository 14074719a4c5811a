"""Scans of boxes with open doors, in which parts and hinges were found, and what a lesson about views of them needs."""

from dataclasses import replace
from types import SimpleNamespace

import roma
import torch
from boxes_with_doors import HINGE, ZERO, box_shape
from true_category import Category

from articulate_ssl.discovery.from_scans import StandingScans
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.inference.view_search import ViewSearch

COUNT, POINTS = 6, 100
SEEN = (ZERO + 0.9, ZERO + 1.8)


def scanned_boxes() -> StandingScans:
    generator, shape = torch.Generator().manual_seed(0), box_shape()
    base = se3(roma.special_procrustes(torch.randn(COUNT, 3, 3, generator=generator)), torch.zeros(COUNT, 3))
    state = torch.linspace(*SEEN, COUNT)[:, None]
    clouds = shape.posed(base, state)
    found = RegisteredShape(shape, base, state, torch.zeros(COUNT, 2, 3), torch.zeros(COUNT))
    order = torch.randperm(clouds.shape[1], generator=generator)
    clouds, part = clouds[:, order], shape.label[order].expand(COUNT, -1)
    found = replace(found, point_part=part, quarters=torch.arange(COUNT) % 2)
    turns = roma.special_procrustes(torch.randn(COUNT, 9, 3, 3, generator=generator))
    return StandingScans(clouds, torch.arange(COUNT), found, turns, 0.3)


def found_elsewhere(scans: StandingScans, frame: torch.Tensor) -> StandingScans:
    """The same, found in another canonical space, where states count from elsewhere and in the other sense."""
    found, middle = scans.found, ZERO + 0.3
    points = found.shape.posed(torch.eye(4)[None], torch.full((1, 1), middle))[0]
    shape = replace(found.shape, points=points, joints=replace(found.shape.joints, axis=-found.shape.joints.axis))
    base, turns = found.base @ invert_se3(frame), scans.turns @ frame[:3, :3].mT
    found = replace(found, shape=shape.in_frame(frame), base=base, state=middle - found.state)
    return replace(scans, found=found, turns=turns)


def module_of_boxes() -> SimpleNamespace:
    """`scans` may be changed; `asked` counts how often they were wanted."""
    states, frames, shape = StateRange(1), PartFrames(2), box_shape()
    states.seen.copy_(torch.tensor([SEEN]))
    frames.flat.fill_(True)
    frames.axes[1] = roma.rotvec_to_rotmat(-ZERO * HINGE)  # the door, which is closed at ZERO
    frames.measured.fill_(True)
    frames.direction.copy_(HINGE)
    made = SimpleNamespace(states=states, part_frames=frames, num_points=POINTS, closed_views_samples=20, asked=0)
    made.scans = scanned_boxes()

    def standing_scans(_data, num_points):
        made.asked += 1
        assert num_points == POINTS
        return made.scans

    parts = torch.cat([(shape.label == part).nonzero()[:200, 0] for part in range(2)])
    even = Category(replace(shape, points=shape.points[parts], label=shape.label[parts]))
    made.recipe = SimpleNamespace(standing_scans=standing_scans)
    made.estimator = SimpleNamespace(closed_views=ViewSearch(2), part_frames=frames)
    category = SimpleNamespace(articulated_shape=lambda _: made.shape)
    made.shape, made.device = shape, torch.device("cpu")
    made.articulated = SimpleNamespace(category=category, joint_type=REVOLUTE, category_at=even.category_at)
    return made
