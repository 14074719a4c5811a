"""Copies of clouds in other proportions and joint states keep what belongs together, and label what is unseen."""

import torch
from articulated_objects import chest_of_height, clouds

from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.discovery.varied_clouds import in_other_proportions, varied
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.shape.joints import Joints


def _standing(height: float, seed: int, limit: float = 0.3):
    data = clouds(chest_of_height(height, limit), count=4, points=512, resample=True, seed=seed)
    boxes, _, _ = unit_boxes(transform_points(invert_se3(data.base), data.points))
    joints = Joints(KinematicChain(3, 0, (0, 0), (1, 2)), data.axis, data.pivot, PRISMATIC)
    return LabelledClouds(boxes, data.part.expand(4, -1)), joints


def _generator():
    return torch.Generator().manual_seed(0)


def test_no_two_points_change_places_and_the_box_stays():
    points = _standing(0.2, seed=0)[0].points
    found = in_other_proportions(points, 2, _generator())
    torch.testing.assert_close(found[:4], points, atol=0, rtol=0)
    for copies in found[4:].split(4):
        assert (copies - points).abs().max() > 0.05
        for axis in range(3):
            order = points[..., axis].argsort(dim=1)
            assert (copies[..., axis].gather(1, order).diff(dim=1) >= -1e-6).all()
        for end in (torch.amin, torch.amax):
            torch.testing.assert_close(end(copies, 1), end(points, 1))


def test_parts_slide_as_a_whole_along_their_axes():
    labelled, joints = _standing(0.2, seed=0)
    flat = labelled._replace(points=labelled.points * torch.tensor([0.0, 1.0, 1.0]))
    found = varied(flat, joints, _generator())
    assert len(found.points) == len(found.part) and torch.equal(found.part[-4:], labelled.part)
    # What has no extent along the axis shows the slides alone, whatever the stretch.
    for part in range(3):
        along = found.points[-1, found.part[-1] == part, 0]
        assert along.max() - along.min() < 1e-5
    along = torch.stack([found.points[-1, found.part[-1] == part, 0].mean() for part in range(3)])
    assert (along[:, None] - along).abs()[0, 1:].min() > 0.01 and (along[1] - along[2]).abs() > 0.01


def test_many_clouds_have_few_copies():
    labelled, joints = _standing(0.2, seed=0)
    for times, copies in ((1, 16), (100, 10), (300, 4)):
        many = LabelledClouds(labelled.points[:, :8].repeat(times, 1, 1), labelled.part[:, :8].repeat(times, 1))
        assert len(varied(many, joints, _generator()).points) == 4 * times * (1 + copies)


def test_chests_of_other_heights_and_states_are_labelled_better():
    labelled, joints = _standing(0.32, seed=0, limit=0.05)
    asked, _ = _standing(0.2, seed=1, limit=0.5)

    def right(gallery: LabelledClouds) -> float:
        return float((gallery.votes(asked.points, 3).argmax(dim=-1) == asked.part).float().mean())

    assert right(varied(labelled, joints, _generator())) > right(labelled) + 0.03


def test_the_same_seed_makes_the_same_copies():
    labelled, joints = _standing(0.2, seed=0)
    first, second = (varied(labelled, joints, _generator()).points for _ in range(2))
    torch.testing.assert_close(first, second, atol=0, rtol=0)
