"""Which way round an object is in a depth view, and which part its points are of: as in the views most like it.

Where scans of some objects taught (`discovery.from_scans`), views of them with known poses are at hand, of objects in
other proportions and states. A chest that a network turns over is still more like chests from the same side than like
others; one shape that is registered from all sides is not, as chests differ more than their sides do. On development
views of four categories this alone is as right as the network or better (docs/experiments.md, step 99), so it decides;
how the object is turned exactly, and its joints, the network and registration say better. Which part a point is of is
said by both: objects that are built otherwise than the category's shape show in some views, too.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from articulate_ssl.discovery.registration import register_rigid
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.candidates import angle_to, rivals
from articulate_ssl.inference.view_parts import ViewParts
from articulate_ssl.inference.votes import Votes
from articulate_ssl.ops.chamfer import nearest_distance, nearest_index
from articulate_ssl.ops.few_bytes import from_few_bytes, in_few_bytes

# Views that are kept, and points of each. Four times as many were as right, and took twice as long.
_VIEWS, _POINTS = 1000, 256
_COMPARED = 128  # points of each by which all are compared with a cloud
_NEAREST = 30  # views that are registered to the cloud
# Views whose objects are turned about as one's, where that is known, and how many of these are registered: with 30, all
# of 90 views of safes are explained alike (docs/experiments.md, step 311). Chosen.
_ALIKE, _NEAREST_ALIKE = 60, 12
_SCALES, _ROUNDS = (0.08, 0.03), 6  # of that registration
_VOTING = 5  # of those, with the least errors, that say which parts points are of
_BUFFERS = ("views", "step", "part", "base", "state", "quarters")


class Seen(NamedTuple):
    """What views say about B clouds.

    Attributes:
        base: [B, 2, 4, 4] base poses, as in the view most like the cloud, and in the likeliest of those from another
            side (the same, if there is none).
        state: [B, 2, J] joint states.
        margin: [B] between the two, 1 if they are the same (`Prediction.margin`).
        votes: Which parts points are of in the views most like the cloud.
    """

    base: Tensor
    state: Tensor
    margin: Tensor
    votes: Votes

    def with_rows(self, index: Tensor, other: Seen) -> Seen:
        """The same, but clouds [n] as `other`, which is of these, has them, and what was said of them as rivals."""
        base, state = (
            own.index_copy(0, index, torch.stack([new[:, 0], own[index, 0]], dim=1))
            for own, new in ((self.base, other.base), (self.state, other.state))
        )
        share = self.votes.share.index_copy(0, index, other.votes.share)
        margin = self.margin.index_copy(0, index, other.margin)
        return Seen(base, state, margin, Votes(self.votes.points, share))


class ViewSearch(nn.Module):
    """Poses, joint states and parts of the simulated views that a depth view is most like.

    Attributes:
        views: [V, P, 3] int8, simulated, in steps of the lengths `step` [V]; none before anything was learnt.
        part: [V, P] uint8, which part their points are of.
        base: [V, 4, 4] canonical object space -> view.
        state: [V, J] joint states.
        quarters: [V] int64, by how many quarters their objects are turned until they stand (`RegisteredShape`).
        parts: Which part points are of, if views have taught that.
    """

    def __init__(self, num_parts: int) -> None:
        super().__init__()
        self.num_parts = num_parts
        self.register_module("parts", None)
        self.register_buffer("views", torch.zeros(0, _POINTS, 3, dtype=torch.int8))
        self.register_buffer("step", torch.zeros(0))
        self.register_buffer("part", torch.zeros(0, _POINTS, dtype=torch.uint8))
        self.register_buffer("base", torch.zeros(0, 4, 4))
        self.register_buffer("state", torch.zeros(0, num_parts - 1))
        self.register_buffer("quarters", torch.zeros(0, dtype=torch.long))

    @property
    def learnt(self) -> bool:
        """Whether there are views."""
        return len(self.views) > 0

    def forget(self) -> None:
        """As before there were any."""
        self.views, self.quarters, self.parts = self.views[:0], self.quarters[:0], None

    def learn(
        self,
        views: Tensor,  # [n, N, 3] farthest-point order
        base: Tensor,  # [n, 4, 4]
        state: Tensor,  # [n, J]
        part: Tensor,  # [n, N] which part every point is of
        quarters: Tensor | None = None,  # [n]
    ) -> None:
        """Keep some of these views, spread evenly; but of what lies as many as of what stands, if there are.

        Few objects lie, and what is not shown from about where a camera sees it is taken for another.
        """
        quarters = torch.zeros(len(views), dtype=torch.long) if quarters is None else quarters
        lie, stand = quarters.nonzero()[:, 0], (quarters == 0).nonzero()[:, 0]
        lie = _evenly(lie, max(_VIEWS // 2, _VIEWS - len(stand)))
        some = torch.cat([_evenly(stand, _VIEWS - len(lie)), lie])
        self.quarters = quarters[some].to(self.quarters, copy=True)
        views, step = in_few_bytes(views[some, :_POINTS])
        self.views = views.to(self.views)
        self.part = part[some, :_POINTS].to(self.part, copy=True)
        self.step, self.base, self.state = (value.to(self.base, copy=True) for value in (step, base[some], state[some]))

    @property
    def standing(self) -> Tensor:  # [V, P, 3]
        """The views, turned as canonical object space is."""
        return from_few_bytes(self.views.to(self.base), self.step) @ self.base[:, :3, :3]

    @torch.no_grad()
    def search(
        self,
        points: Tensor,  # [B, N, 3] depth views, farthest-point order
        turn: Tensor | None = None,  # [B, 3, 3] canonical object space -> view
        shown: Tensor | None = None,  # [S]
    ) -> Seen:
        """Compare with all views, register those that are most alike, and ask the best of these.

        Args:
            turn: Only views whose objects are turned about so are compared.
            shown: And of these only those; None are all.
        """
        views, step, base, state = (value.to(points) for value in (self.views, self.step, self.base, self.state))
        views = from_few_bytes(views, step)
        every = torch.arange(len(views), device=points.device) if shown is None else shown
        count = _NEAREST if turn is None else _NEAREST_ALIKE
        thin, still = views[:, :_COMPARED].contiguous(), torch.eye(3).to(points)[None]
        found, states, errors, votes = [], [], [], []
        for i, cloud in enumerate(points):
            among = every if turn is None else every[_most_alike(base[every, :3, :3], turn[i])]
            own, copies = thin[among], cloud[:_COMPARED].expand(len(among), -1, -1)
            distance = nearest_distance(copies, own).mean(dim=1) + nearest_distance(own, copies).mean(dim=1)
            nearest = among[distance.topk(min(count, len(among)), largest=False).indices]
            pose, error = register_rigid(cloud[:_POINTS], views[nearest], still, 1, _SCALES, _ROUNDS)
            pose, error = pose[:, 0], error[:, 0]
            found.append(invert_se3(pose) @ base[nearest])
            states.append(state[nearest])
            errors.append(error)
            voting = error.topk(min(_VOTING, len(error)), largest=False).indices
            votes.append(self._votes(transform_points(pose[voting], cloud[None]), views, nearest[voting]))
        pose, state, error = torch.stack(found), torch.stack(states), torch.stack(errors)
        best = error.argmin(dim=1)
        rival, margin = rivals(error, pose, best, torch.ones_like(error, dtype=torch.bool))
        both, rows = torch.stack([best, rival], dim=1), torch.arange(len(points), device=points.device)[:, None]
        return Seen(pose[rows, both], state[rows, both], margin, Votes(points, torch.stack(votes)))

    def _votes(
        self,
        placed: Tensor,  # [C, N, 3] a cloud, registered to some of the views
        views: Tensor,  # [V, P, 3]
        which: Tensor,  # [C] of the views
    ) -> Tensor:  # [N, K]
        """Parts of the nearest points."""
        part = self.part[which].long().gather(1, nearest_index(placed, views[which]))
        return one_hot(part, self.num_parts).to(placed).mean(dim=0)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        """There are any number of views; weights from before there was a search have none, or of none that lie."""
        views = state_dict.get(f"{prefix}views", self.views)
        state_dict.setdefault(f"{prefix}quarters", self.quarters.new_zeros(len(views)))
        for name in _BUFFERS:
            own = getattr(self, name)
            value = state_dict.setdefault(prefix + name, own.clone())
            setattr(self, name, torch.empty_like(value, dtype=own.dtype, device=own.device))
        taught = any(name.startswith(f"{prefix}parts.") for name in state_dict)
        self.parts = ViewParts(self.num_parts).to(self.base).requires_grad_(False) if taught else None
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _most_alike(
    rotation: Tensor,  # [S, 3, 3]
    turn: Tensor,  # [3, 3]
) -> Tensor:
    """Which of the rotations are most like a turn."""
    return angle_to(rotation[None], turn[None])[0].argsort()[:_ALIKE]


def _evenly(rows: Tensor, count: int) -> Tensor:
    """So many of them, or all."""
    return rows[torch.linspace(0, len(rows) - 1, min(len(rows), count)).round().long()]
