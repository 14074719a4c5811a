"""Objects turned within a range only: what shape does not tell apart, which way up it is does."""

from types import SimpleNamespace

import pytest
import roma
import torch
from articulated_objects import clouds
from tiny import tiny_module

from articulate_ssl.discovery.discover import discover
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.geometry.orientation_range import OrientationRange, mean_rotation
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.candidates import Iteration
from articulate_ssl.shape.observation import Observation

# Two like plates and a hinge: turned by 180 degrees about the line between the plates, each is where the other was.
BOOK = (
    [((0, 0, 0), (0.6, 0.7, 0.05)), ((0, 0, 0.06), (0.6, 0.7, 0.11))],
    (0,),
    [((0, 1, 0), (0, 0, 0.055))],
    [(-1.6, -0.5)],
    REVOLUTE,
)


def _turns(degrees, count=200, seed=0):
    return OrientationRange(degrees).draw(count, torch.Generator().manual_seed(seed))


def _angle(rotation):
    return roma.rotmat_geodesic_distance(rotation, torch.eye(3).expand_as(rotation)).rad2deg()


@pytest.mark.parametrize("degrees", [30.0, 100.0, 180.0])
def test_what_is_drawn_is_within_the_range_and_fills_it(degrees):
    angle = _angle(_turns(degrees))
    assert angle.max() <= degrees + 1e-3
    assert angle.max() > 0.9 * degrees
    assert OrientationRange(degrees).contains(_turns(degrees)).all()
    assert OrientationRange(degrees).contains(_turns(180.0)).all() == (degrees == 180)


@pytest.mark.parametrize("degrees", [0.0, -10.0, 200.0])
def test_a_range_that_is_no_angle_is_refused(degrees):
    with pytest.raises(ValueError, match="orientation_range is an angle"):
        OrientationRange(degrees)


def test_alignment_of_any_orientation_is_refused_within_a_range():
    with pytest.raises(ValueError, match="rigid_steps"):
        tiny_module(rigid_steps=2, orientation_range=90.0)


def test_mean_of_rotations_about_a_rotation():
    middle = _turns(180.0, 1)[0]
    turns = _turns(40.0, 500)
    mean = mean_rotation(torch.cat([turns, turns.mT]) @ middle)
    torch.testing.assert_close(mean, middle, rtol=0, atol=1e-5)


def test_hypotheses_outside_the_range_win_only_where_there_is_no_other():
    points = torch.randn(2, 20, 3)
    base = se3(roma.rotvec_to_rotmat(torch.tensor([[0.0, 0, 3.0], [0, 0, 0.5], [0, 0, 1.0]])), torch.zeros(3, 3))
    posed = torch.stack([points, points + 0.1, points + 0.2], dim=1)[:, :, None]  # the first fits, but is turned round
    hypotheses = SimpleNamespace(base=base.expand(2, 3, 4, 4), posed=lambda _every: posed)

    def leading(degrees):
        return Iteration(points, hypotheses, None, Observation(OrientationRange(degrees))).leading(3)

    assert leading(180.0).tolist() == [[0, 1, 2]] * 2
    assert leading(90.0).tolist() == [[1, 2, 0]] * 2
    assert leading(1.0).tolist() == [[0, 1, 2]] * 2


def test_like_parts_are_told_apart_within_a_range():
    data = clouds(BOOK, count=10, points=192, resample=True, rotate=False, seed=1)
    turn = se3(_turns(40.0, 10), torch.zeros(10, 3))
    points = data.points @ turn[:, :3, :3].mT
    true = turn[:, :3, :3] @ data.base[:, :3, :3]
    small = DiscoveryOptions(
        clouds=10,
        search_clouds=10,
        split_clouds=8,
        references=1,
        starts=4,
        jointed=2,
        rounds=1,
        proposals=["random_cuts"],
        cycles=3,
    )

    def found(degrees):
        base = discover(points, 2, REVOLUTE, small, Observation(OrientationRange(degrees))).base[:, :3, :3]
        frame = base.mT @ true  # the same for all clouds but those whose plates are exchanged
        return base, roma.rotmat_geodesic_distance(frame[:, None], frame).rad2deg().max()

    base, spread = found(80.0)
    assert spread < 90  # 10 to 51 of four seeds of clouds; 180 if plates are exchanged
    assert OrientationRange(80.0).contains(base).all()
    assert _angle(mean_rotation(base)) < 15
    assert found(180.0)[1] > 90
