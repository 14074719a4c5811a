"""Poses, states and joint lines of all clouds are adjusted together."""

from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import OVEN, clouds

from articulate_ssl.discovery.one_object.adjustment import Placed, adjusted
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.joints import Joints


@pytest.fixture(scope="module")
def world():
    data = clouds(OVEN, count=8, points=2048, resample=True, seed=1)
    joints = Joints(KinematicChain(2, 0, (0,), (1,)), data.axis.double(), data.pivot.double(), OVEN[4])
    truth = Placed(joints, data.base.double(), data.state.double())
    surfaces = [Surface.of(cloud) for cloud in data.points.double().numpy()]
    return truth, surfaces, data.part.repeat(8, 1).numpy()


def _disturbed(truth: Placed) -> Placed:
    generator = torch.Generator().manual_seed(0)

    def noise(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    turn = roma.rotvec_to_rotmat(0.03 * noise(truth.base[:, 0, :3]))
    base = se3(truth.base[:, :3, :3] @ turn, truth.base[:, :3, 3] + 0.01 * noise(truth.base[:, :3, 3]))
    axis = torch.nn.functional.normalize(truth.joints.axis + 0.05 * noise(truth.joints.axis), dim=-1)
    return Placed(replace(truth.joints, axis=axis), base, truth.state + 0.05 * noise(truth.state))


def _motion_error(placed: Placed, truth: Placed) -> float:
    """Degrees by which the door is turned wrongly against the body, mean over the clouds, whatever the frame."""
    relative = [(p.pose[:, 0, :3, :3].mT @ p.pose[:, 1, :3, :3]) for p in (placed, truth)]
    # Parts have no common rest state: motions from the first cloud to the others are compared.
    first, second = (r[0] @ r.mT for r in relative)
    angle = [roma.rotmat_to_rotvec(r).norm(dim=-1) for r in (first, second)]
    return float((angle[0] - angle[1]).abs().mean().rad2deg())


def test_what_was_disturbed_comes_back(world):
    truth, surfaces, part = world
    start = _disturbed(truth)
    found = adjusted(start, surfaces, part)
    assert _motion_error(start, truth) > 2
    assert _motion_error(found, truth) < 0.3


def test_joint_lines_come_back_too(world):
    truth, surfaces, part = world
    found = adjusted(_disturbed(truth), surfaces, part)
    axis = (found.base[:, :3, :3] @ found.joints.axis[0], truth.base[:, :3, :3] @ truth.joints.axis[0])
    degrees = (axis[0] * axis[1]).sum(dim=-1).abs().clamp(max=1).acos().rad2deg()
    assert degrees.max() < 1


def test_with_labels_exchanged_nothing_comes_back(world):
    truth, surfaces, part = world
    assert _motion_error(adjusted(_disturbed(truth), surfaces, 1 - part), truth) > 1
