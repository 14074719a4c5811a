"""Parts that slide are found by their offsets, and placed in clouds of other depths and widths."""

import pytest
import torch
from articulated_objects import clouds

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.slide_table import DIRECTIONS, Direction, Standing, cluster_slides, offset_costs, place
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

# A cabinet of three walls, with two drawers that slide along x.
CHEST = (
    [((0, 0, 0), (0.4, 0.6, 0.02)), ((0.02, 0.05, 0.1), (0.41, 0.55, 0.25)), ((0.02, 0.05, 0.3), (0.41, 0.55, 0.5))],
    (0, 0),
    [((1, 0, 0), (0, 0, 0)), ((1, 0, 0), (0, 0, 0))],
    [(0.0, 0.3), (0.0, 0.3)],
    PRISMATIC,
)


@pytest.fixture(scope="module")
def chest():
    """Clouds in the frame of the chest."""
    return clouds(CHEST, count=12, points=900, resample=True, rotate=False, seed=3)


def _standing(data):
    return transform_points(torch.linalg.inv(data.base), data.points)


def test_standing_clouds_have_one_width_and_their_backs_on_one_plane(chest):
    points = _standing(chest)
    for direction in DIRECTIONS:
        standing = Standing.of(points, direction)
        back = (direction.sign * standing.points[..., direction.axis]).quantile(0.01, dim=1)
        torch.testing.assert_close(back, torch.full_like(back, -0.66), atol=1e-5, rtol=0)
        for across in set(range(3)) - {direction.axis}:
            low, high = standing.points[..., across].quantile(torch.tensor([0.01, 0.99]), dim=1)
            torch.testing.assert_close(high - low, torch.full_like(low, 0.7), atol=1e-4, rtol=0)
        again = standing.points * standing.width[:, None] + standing.center[:, None]
        torch.testing.assert_close(again, points, atol=1e-5, rtol=0)


def test_pieces_that_slide_alike_are_found(chest):
    points, direction = _standing(chest), Direction(0, 1)
    standing = Standing.of(points, direction)
    fields = DistanceFields.of(standing.points)
    table = torch.stack([offset_costs(standing.points[0], fields, i, direction) for i in range(12)], dim=1)
    generator = torch.Generator().manual_seed(0)
    slides = cluster_slides(table, 3, 0.05, 20, generator)
    drawers = [slides.label[chest.part == part].mode().values for part in (1, 2)]
    assert drawers[0] != drawers[1]
    for part, piece in zip((1, 2), drawers, strict=True):
        assert (slides.label[chest.part == part] == piece).float().mean() > 0.6
        moved = slides.offset[piece]
        assert torch.corrcoef(torch.stack([moved, chest.state[:, part - 1]]))[0, 1] > 0.8
    assert cluster_slides(table, 3, 0.4, 5, generator) is None  # no three pieces of two fifths each


def test_a_shape_is_placed_in_clouds_of_other_proportions(chest):
    chain = KinematicChain(3, 0, (0, 0), (1, 2))
    shape = ArticulatedShape(chest.rest, chest.part, Joints(chain, chest.axis, chest.pivot, PRISMATIC))
    proportion = torch.tensor([1.2, 0.8, 1.1])
    points = _standing(chest) * proportion + torch.tensor([0.3, -0.2, 0.1])
    placed = place(shape, points, 600)
    assert placed.base.shape == (12, 4, 4, 4) and placed.state.shape == (12, 4, 2)
    assert placed.log_stretch.shape == (12, 4, 3, 3)
    best = placed.state[:, 0] - proportion[0] * chest.state
    assert best.abs().median() < 0.03
    found = placed.log_stretch[:, 0, 0].median(dim=0).values.exp()
    torch.testing.assert_close(found, proportion, atol=0.08, rtol=0)
