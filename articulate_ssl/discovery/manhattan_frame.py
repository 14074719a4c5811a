"""The Manhattan frame of a cloud: three axes at right angles that most of its surface is parallel or square to.

Cabinets, ovens and chests have one. It is found on every cloud by itself, from its normals, and of whole clouds from
where points pile up (`sharp_profiles`), up to the 24 rotations of the cube; `synchronization` decides between those for
a whole collection.
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.sharp_profiles import sharp_frame
from articulate_ssl.ops.neighborhood import nearest_neighbors

_STRIDE = 4  # normals are measured at every fourth point
# From so many neighbours, and how thin they are at most, in their own width, if they lie in a plane and not across an
# edge. A noisy cloud has no planes of so few neighbours that are so thin: the first of these windows counts in which
# enough points have one, of depth views of chests 37 % without noise in the first (docs/experiments.md, step 184).
_WINDOWS = ((14, 0.1), (14, 0.3), (40, 0.3), (100, 0.4), (200, 0.4))
_ENOUGH, _SMALL = 0.1, 1 / 20  # of the points where normals are measured; largest share of a cloud in a wider window
_FEWEST = 20  # planes that make a frame; with a handful, any rotation fits
_STARTS, _ROUNDS = 20, 12  # random rotations, each of which stands for 24
CAP = 10.0  # degrees: a normal further from every axis counts as this far; three times as much in the first round


def surface_normals(
    clouds: Tensor,  # [n, N, 3]
) -> tuple[Tensor, Tensor]:  # [n, m, 3] unit, [n, m]
    """Normals of local planes at every fourth point, up to sign, and whether there is a plane (0 or 1)."""
    normals, planar = zip(*map(_normals, clouds), strict=True)
    return torch.stack(normals), torch.stack(planar).to(clouds)


def _normals(
    cloud: Tensor,  # [N, 3]
) -> tuple[Tensor, Tensor]:  # [m, 3], [m] bool
    """As `surface_normals`, in the first window that sees planes enough, else in the one that sees most."""
    most, found, at = -1.0, None, torch.arange(0, len(cloud), _STRIDE, device=cloud.device)[None]
    for neighbours, flatness in _WINDOWS:
        if found is not None and neighbours > _SMALL * len(cloud):
            break
        patch = nearest_neighbors(cloud[None], neighbours, at).offset[0].permute(1, 2, 0)  # [m, k, 3]
        offset = patch - patch.mean(dim=1, keepdim=True)
        variance, directions = torch.linalg.eigh(offset.mT @ offset)
        planar = variance[:, 0] < flatness**2 * variance[:, 1]
        share = float(planar.to(cloud).mean())
        if share > most:
            most, found = share, (directions[..., 0], planar)
        if share >= _ENOUGH:
            break
    return found


def manhattan_frames(
    clouds: Tensor,  # [n, N, 3] with as many points as there are
    generator: torch.Generator,
    whole: bool = False,
) -> tuple[Tensor, Tensor]:  # [n, 3, 3], [n]
    """Rotations that bring clouds into their frames, and the mean angle (degrees, capped) of normals to their axes.

    From random rotations: give every normal to its nearest axis, if one is near enough, and turn the axes to their
    normals; the start that leaves the smallest angle wins. A cloud of few planes has no frame: its angle is the cap.

    Args:
        whole: Clouds show all sides: frames are those near which points pile up most, and angles of those before.
    """
    normals, weight = surface_normals(clouds)
    quaternion = functional.normalize(torch.randn(_STARTS, 4, generator=generator), dim=-1)
    rotation = roma.unitquat_to_rotmat(quaternion).to(clouds).expand(len(clouds), -1, 3, 3)
    for step in range(_ROUNDS):
        reach = torch.tensor(CAP * (3 - 2 * step / (_ROUNDS - 1))).deg2rad().cos()
        seen = torch.einsum("nhij,nmj->nhmi", rotation, normals)
        largest = seen.abs().amax(dim=-1, keepdim=True)
        to_axis = seen.sign() * (seen.abs() == largest) * (largest > reach) * weight[:, None, :, None]
        rotation = roma.special_procrustes(torch.einsum("nhmi,nmj->nhij", to_axis, normals))
    angle = torch.einsum("nhij,nmj->nhmi", rotation, normals).abs().amax(dim=-1).clamp(max=1).acos().rad2deg()
    angle = (weight[:, None] * angle.clamp(max=CAP)).sum(dim=-1) / weight.sum(dim=-1)[:, None].clamp(min=1)
    angle = angle.masked_fill(weight.sum(dim=1, keepdim=True) < _FEWEST, CAP)
    best = angle.argmin(dim=1)
    rows = torch.arange(len(clouds), device=clouds.device)
    found, angle = rotation[rows, best], angle[rows, best]
    if whole:
        found = torch.stack([sharp_frame(*one) for one in zip(clouds, found, rotation, strict=True)])
    return found, angle
