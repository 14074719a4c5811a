"""What lies is believed where nothing upright explains it."""

from dataclasses import replace

import roma
import torch
from boxes_with_doors import HINGE, ZERO, box_shape

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.upright_fit import lie
from articulate_ssl.geometry.se3 import se3

COUNT = 4


def _registered(base, state, clouds) -> RegisteredShape:
    shape = box_shape()
    fit = InstanceFit(shape, base, state, torch.Generator().manual_seed(0))
    fit.optimise(clouds, 4, shared=False)
    return RegisteredShape.of(fit, clouds)


def test_of_two_explanations_the_upright_one_needs_only_to_fit_as_well():
    shape, generator = box_shape(), torch.Generator().manual_seed(0)
    base = se3(roma.special_procrustes(torch.randn(COUNT, 3, 3, generator=generator)), torch.zeros(COUNT, 3))
    state = torch.linspace(ZERO + 0.9, ZERO + 1.8, COUNT)[:, None]
    clouds = shape.posed(base, state)
    clouds = clouds[:, torch.randperm(clouds.shape[1], generator=generator)[:1024]]
    over = roma.rotvec_to_rotmat(torch.pi * torch.linalg.cross(HINGE, _normal()))  # upside down
    turns = over.expand(COUNT, 3, 3)
    found = replace(_registered(base, state, clouds), sought=torch.tensor([[ZERO, ZERO + 2.2]]))
    # As they are: turned over, the door is on the other side.
    assert lie(found, clouds, turns).all()
    wrong = _registered(base @ se3(over, torch.zeros(3)), torch.full_like(state, ZERO), clouds)
    wrong = replace(wrong, sought=found.sought)
    assert (wrong.error > found.error).all() and not lie(wrong, clouds, turns.mT).any()
    assert lie(found.of_clouds(slice(0)), clouds[:0], turns[:0]).shape == (0,)


def _normal() -> torch.Tensor:
    """Of a face that the hinge lies in."""
    return torch.eye(3)[int(HINGE.abs().argmin())]
