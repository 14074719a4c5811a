"""Joint lines are also tried at the edges of parts."""

from dataclasses import replace

import torch
from articulated_objects import LAPTOP, clouds, true_shape

from articulate_ssl.discovery.edge_hinges import hinged_at_edges
from articulate_ssl.discovery.instance_fit import InstanceFit


def test_a_distant_joint_line_is_also_tried_along_the_edges_of_its_part():
    data = clouds(LAPTOP, count=8, points=256)
    across = torch.linalg.cross(data.axis, torch.tensor([[0.3, -0.5, 0.8]]))
    distant = data.pivot + 0.5 * torch.nn.functional.normalize(across, dim=-1)
    shape = true_shape(LAPTOP, data)
    shape = replace(shape, joints=replace(shape.joints, pivot=distant))
    fit = InstanceFit(shape, data.base, data.state, torch.Generator().manual_seed(0))
    others = hinged_at_edges(fit)
    distance = [torch.linalg.cross(o.shape.joints.pivot - data.pivot, data.axis).norm() for o in others]
    assert len(others) == 4 and min(distance) < 0.06 and max(distance) > 0.2
    assert min(o.error(data.points).mean() for o in others) < fit.error(data.points).mean()
