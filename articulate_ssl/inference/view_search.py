"""Which way round an object is in a depth view: as in the simulated views that it is most like.

Where scans of some objects taught (`discovery.from_scans`), views of them with known poses are at hand, of objects in
other proportions and states. A chest that a network turns over is still more like chests from the same side than like
others; one shape that is registered from all sides is not, as chests differ more than their sides do. On development
views of four categories this alone is as right as the network or better (docs/experiments.md, step 99), so it decides;
how the object is turned exactly, and where its parts are, the network and registration say better.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.discovery.registration import register_rigid
from articulate_ssl.geometry.se3 import invert_se3
from articulate_ssl.inference.candidates import rivals
from articulate_ssl.ops.chamfer import nearest_distance

# Views that are kept, and points of each. Four times as many were as right, and took twice as long.
_VIEWS, _POINTS = 1000, 256
_COMPARED = 128  # points of each by which all are compared with a cloud
_NEAREST = 30  # views that are registered to the cloud
_SCALES, _ROUNDS = (0.08, 0.03), 6  # of that registration
_BUFFERS = ("views", "base", "state")


class ViewSearch(nn.Module):
    """Poses and joint states of the simulated views that a depth view is most like.

    Attributes:
        views: [V, P, 3] float16, simulated; none before anything was learnt.
        base: [V, 4, 4] canonical object space -> view.
        state: [V, J] joint states.
    """

    def __init__(self, num_joints: int) -> None:
        super().__init__()
        self.register_buffer("views", torch.zeros(0, _POINTS, 3, dtype=torch.float16))
        self.register_buffer("base", torch.zeros(0, 4, 4))
        self.register_buffer("state", torch.zeros(0, num_joints))

    @property
    def learnt(self) -> bool:
        """Whether there are views."""
        return len(self.views) > 0

    def learn(
        self,
        views: Tensor,  # [n, N, 3] farthest-point order
        base: Tensor,  # [n, 4, 4]
        state: Tensor,  # [n, J]
    ) -> None:
        """Keep some of these views, spread evenly."""
        some = torch.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().long()
        self.views = views[some, :_POINTS].to(self.views.device, torch.float16, copy=True)
        self.base, self.state = (value[some].to(self.base, copy=True) for value in (base, state))

    @torch.no_grad()
    def search(
        self,
        points: Tensor,  # [B, N, 3] depth views, farthest-point order
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, 2, 4, 4], [B, 2, J], [B]
        """Base poses and joint states of the objects: the likeliest, and of those turned another way the likeliest.

        The third is the margin between the two; where none is turned another way, they are the same, and it is 1.
        """
        views, base = self.views.to(points), self.base.to(points)
        thin = views[:, :_COMPARED].contiguous()
        found, states, errors = [], [], []
        for cloud in points:
            copies = cloud[:_COMPARED].expand(len(thin), -1, -1)
            distance = nearest_distance(copies, thin).mean(dim=1) + nearest_distance(thin, copies).mean(dim=1)
            nearest = distance.topk(min(_NEAREST, len(thin)), largest=False).indices
            still = torch.eye(3).to(cloud)[None]
            pose, error = register_rigid(cloud[:_POINTS], views[nearest], still, 1, _SCALES, _ROUNDS)
            found.append(invert_se3(pose[:, 0]) @ base[nearest])
            states.append(self.state[nearest].to(points))
            errors.append(error[:, 0])
        pose, state, error = torch.stack(found), torch.stack(states), torch.stack(errors)
        best = error.argmin(dim=1)
        rival, margin = rivals(error, pose, best, torch.ones_like(error, dtype=torch.bool))
        both, rows = torch.stack([best, rival], dim=1), torch.arange(len(points), device=points.device)[:, None]
        return pose[rows, both], state[rows, both], margin

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        """There are any number of views; weights from before there was a search have none."""
        for name in _BUFFERS:
            own = getattr(self, name)
            value = state_dict.setdefault(prefix + name, own.clone())
            setattr(self, name, torch.empty_like(value, dtype=own.dtype, device=own.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)
