"""The Manhattan frame of a cloud: three axes at right angles that most of its surface is parallel or square to.

Cabinets, ovens and chests have one. It is found on every cloud by itself, from its normals alone, up to the 24
rotations of the cube; `synchronization` decides between those for a whole collection.
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor
from torch.nn import functional

_STRIDE, _NEIGHBOURS = 4, 14  # normals are measured at every fourth point, from so many neighbours
_FLATNESS = 0.1  # a neighbourhood this thin, in its own width, is a plane's; a thicker one lies across an edge
_FEWEST = 20  # planes that make a frame; with a handful, any rotation fits
_STARTS, _ROUNDS = 20, 12  # random rotations, each of which stands for 24
_CAP = 10.0  # degrees: a normal further from every axis counts as this far; three times as much in the first round


def surface_normals(
    clouds: Tensor,  # [n, N, 3]
) -> tuple[Tensor, Tensor]:  # [n, m, 3] unit, [n, m]
    """Normals of local planes at every fourth point, up to sign, and whether there is a plane (0 or 1)."""
    normals, planar = [], []
    for cloud in clouds:
        near = torch.cdist(cloud[::_STRIDE], cloud).topk(_NEIGHBOURS, largest=False).indices  # [m, k]
        patch = cloud[near]
        offset = patch - patch.mean(dim=1, keepdim=True)
        variance, directions = torch.linalg.eigh(offset.mT @ offset)
        normals.append(directions[..., 0])
        planar.append(variance[:, 0] < _FLATNESS**2 * variance[:, 1])
    return torch.stack(normals), torch.stack(planar).to(clouds)


def manhattan_frames(
    clouds: Tensor,  # [n, N, 3] with as many points as there are
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # [n, 3, 3], [n]
    """Rotations that bring clouds into their frames, and the mean angle (degrees, capped) of normals to their axes.

    From random rotations: give every normal to its nearest axis, if one is near enough, and turn the axes to their
    normals; the start that leaves the smallest angle wins. A cloud of few planes has no frame: its angle is the cap.
    """
    normals, weight = surface_normals(clouds)
    quaternion = functional.normalize(torch.randn(_STARTS, 4, generator=generator), dim=-1)
    rotation = roma.unitquat_to_rotmat(quaternion).to(clouds).expand(len(clouds), -1, 3, 3)
    for step in range(_ROUNDS):
        reach = torch.tensor(_CAP * (3 - 2 * step / (_ROUNDS - 1))).deg2rad().cos()
        seen = torch.einsum("nhij,nmj->nhmi", rotation, normals)
        largest = seen.abs().amax(dim=-1, keepdim=True)
        to_axis = seen.sign() * (seen.abs() == largest) * (largest > reach) * weight[:, None, :, None]
        rotation = roma.special_procrustes(torch.einsum("nhmi,nmj->nhij", to_axis, normals))
    angle = torch.einsum("nhij,nmj->nhmi", rotation, normals).abs().amax(dim=-1).clamp(max=1).acos().rad2deg()
    angle = (weight[:, None] * angle.clamp(max=_CAP)).sum(dim=-1) / weight.sum(dim=-1)[:, None].clamp(min=1)
    angle = angle.masked_fill(weight.sum(dim=1, keepdim=True) < _FEWEST, _CAP)
    best = angle.argmin(dim=1)
    rows = torch.arange(len(clouds), device=clouds.device)
    return rotation[rows, best], angle[rows, best]
