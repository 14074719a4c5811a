"""What joints explain tells right splits from wrong ones, whichever object is the more typical."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import DRAWER, GLASSES, OVEN, clouds, true_shape

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.joint_gain import best_by_joints, joint_gain
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape

OPTIONS = DiscoveryOptions(cycles=6, keep=1.0)


def registered(design, data, axes=None, **changes) -> RegisteredShape:
    """The true shape, but for what is changed, where it is in the clouds."""
    shape = replace(true_shape(design, data), **changes)
    fit = InstanceFit(shape, data.base, data.state.clone(), torch.Generator().manual_seed(0), axes)
    fit.optimise(data.points, OPTIONS.cycles, shared=False)
    return RegisteredShape.of(fit, data.points)


def gain(found, data) -> float:
    return joint_gain(found, data.points, OPTIONS)


def test_a_joint_that_explains_makes_up_for_an_odd_object():
    """Of a wrong split with a smaller error, as typical objects have, and the right one; not if it is far smaller."""
    data = clouds(OVEN, count=8, points=512, resample=True)
    at_rest = data._replace(state=data.state.mean(dim=0).expand_as(data.state))
    right, wrong = registered(OVEN, data), registered(OVEN, at_rest, label=(data.rest[:, 1] > 0.3).long())
    more = gain(right, data) - gain(wrong, data)
    assert more > 0.002
    for share, best in ((0.5, right), (1.5, wrong)):
        typical = replace(wrong, error=right.error - share * more)
        for candidates in ([right, typical], [typical, right]):
            chosen = best_by_joints(candidates, data.points, OPTIONS)
            assert torch.equal(chosen.shape.label, best.shape.label)


def test_the_joint_that_explains_least_counts():
    """With one temple always as it is, the other explains nothing about the first."""
    data = clouds(GLASSES, count=12, points=256, resample=True)
    both = gain(registered(GLASSES, data), data)
    still = clouds((*GLASSES[:3], [(-1.3, 0.0), (-0.6, -0.59)], GLASSES[4]), count=12, points=256, resample=True)
    assert both > 0.005
    assert gain(registered(GLASSES, still), still) == pytest.approx(0, abs=0.3 * both)


def test_slides_explain_in_a_common_frame():
    axes, stuck = torch.eye(3).repeat(2, 1, 1), (*DRAWER[:3], [(0.2, 0.201)], DRAWER[4])
    slides, rests = (
        gain(registered(design, data, axes), data)
        for design, data in ((one, clouds(one, count=12, points=256, resample=True)) for one in (DRAWER, stuck))
    )
    assert slides > 5 * abs(rests)


def test_what_is_asked_stays_as_it_was():
    data = clouds(OVEN, count=6, points=128, resample=True)
    found = registered(OVEN, data)
    before = [value.clone() for value in (found.base, found.state, found.log_stretch, found.error)]
    gain(found, data)
    for value, old in zip((found.base, found.state, found.log_stretch, found.error), before, strict=True):
        assert torch.equal(value, old)
