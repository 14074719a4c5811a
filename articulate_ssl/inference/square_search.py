"""Boxes with doors are sought again, square to their own faces, with doors as far as closed.

Training shows doors that are open, as the paper's are, and users scan closed ones. There explanations failed, and not
because others fit as well: of 21 ovens that were explained wrongly, their doors less than 45 degrees open, all were
explained better by the truth, which the search had put behind others or lost (docs/experiments.md, step 274). A box
says how it is turned, up to the 24 rotations of the cube: its faces are square to the axes of its Manhattan frame. And
a box that is square has its cloud's extents, by which the category's shape is stretched before it is registered, from
each of these rotations and from joint states up to that of a closed door. Where the best of them is turned another way
than the explanation, where this has a state that training did not show, or hardly fits better than its rival, the few
that fit best take the cloud's own proportions, without which fits do not tell, and the nearest explanation wins.

Views show too little of a box for that, and plates say nothing about which of them is which.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.inference.contest import Contest
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.network.hypotheses import Hypotheses

# All chosen on development ovens (docs/experiments.md, step 274).
_UNSURE = 0.5  # margins below
_TRIED = 6  # that take proportions; the truth is among the first five of most
_STRETCHED = 1.6  # at most, or its inverse
_POINTS, _SCALES, _ROUNDS = 128, (0.06, 0.03), 4  # of the registration
# Its error has to be below this share of that of what training showed: others explain a few of those by 4 % less.
_CLEARLY = 0.95
# Of its largest extent the smallest of a box at least (bodies of the package: .66 to .83, plates: .07 and .09).
_THICK = 0.25


class SquareSearch:
    """See above.

    Args:
        final: How explanations are fitted in the end, by a registration that says which joint states there are.
    """

    def __init__(self, final: FinalFit) -> None:
        self.final = final

    @property
    def known(self) -> bool:
        """Whether it applies: complete clouds of a box that has a door, whose faces say how they are turned."""
        final, articulated = self.final, self.final.articulated
        turns = articulated.num_parts == 2 and articulated.joint_type == REVOLUTE
        observation, frames = final.registration.observation, final.part_frames
        complete = observation.bidirectional and not observation.orientation.limited
        if not (turns and complete and final.fits and frames.flat.all()):
            return False
        shape = articulated.category.articulated_shape(REVOLUTE)
        body = shape.part(shape.joints.chain.root) @ frames.axes[shape.joints.chain.root]
        extent = body.amax(dim=0) - body.amin(dim=0)
        return bool(extent.min() > _THICK * extent.max())

    def measure(self) -> None:
        """Find out at which joint state the door is closed, unless that is known."""
        states, final = self.final.registration.states, self.final
        if not states.rests and self.known:
            shape = final.articulated.category.articulated_shape(REVOLUTE)
            states.set_rest(closed_state(shape, states.known, final.part_frames))

    def sought(
        self,
        one: Hypotheses,  # H = 1, in the clouds' proportions
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Explanations, or those square to the clouds' faces that fit better."""
        final, states = self.final, self.final.registration.states
        if not self.known or dense is None:
            return one, rival, margin
        base, state = self._square(points, dense)
        showed = states.showed(one.state[:, 0])
        another = angle_to(one.base[..., :3, :3], base[:, 0, :3, :3])[:, 0] > ANOTHER_WAY
        rows = (~showed | another | (margin < _UNSURE)).nonzero()[:, 0]
        if not len(rows):
            return one, rival, margin
        own, seen, least = points[rows], dense[rows], torch.where(showed[rows], _CLEARLY, 1.0)
        base, state = base[rows], state[rows]
        start = one.rows(rows), rival.rows(rows), margin[rows]
        contest = Contest(*start, final.distance(start[0], own), self._as_rival)
        for k in range(min(_TRIED, base.shape[1])):
            tried = final.articulated.category_at(base[:, k : k + 1], state[:, k : k + 1])
            tried = final.in_proportion(tried, own, seen)
            allowed = states.contains(tried.state[:, 0])
            contest, won = contest.against(tried, final.distance(tried, own), allowed, least)
            least = least.index_fill(0, won, 1.0)
        return (
            one.with_rows(rows, contest.one),
            rival.with_rows(rows, contest.rival),
            margin.index_copy(0, rows, contest.margin),
        )

    def _as_rival(self, one: Hypotheses) -> Hypotheses:
        """The category's own shape, as rivals have it, where an explanation has that which clouds have in common."""
        return self.final.articulated.category_at(one.base, one.state)

    def _square(
        self,
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3]
    ) -> tuple[Tensor, Tensor]:  # [B, C, 4, 4], [B, C, 1]
        """Base poses and joint states of registrations from the 24 rotations of the cube, best first."""
        final, states = self.final, self.final.registration.states
        shape = final.articulated.category.articulated_shape(REVOLUTE)
        axes = final.part_frames.axes[shape.joints.chain.root]
        rotations = rotation_group(24).elements.to(points) @ axes.mT  # [H, 3, 3]
        starts, closed = states.starts().to(points), states.rest.to(points)[None]
        starts = torch.cat([closed, closed + (starts[:1] - closed) / 4, starts])  # [Q, 1]
        sizes = len(points), len(rotations), len(starts)

        posed = shape.posed(torch.eye(4).to(points).expand(len(starts), 4, 4), starts)
        turned = torch.einsum("hij,qtj->hqti", rotations, posed)
        least, most = turned.amin(dim=2), turned.amax(dim=2)
        frames, _ = manhattan_frames(dense, torch.Generator().manual_seed(0))  # of clouds
        inside = points @ frames.mT
        low, high = inside.amin(dim=1), inside.amax(dim=1)
        middle = (low + high) / 2
        # The cloud takes the shape's extents: that is registered rigidly then.
        ratio = (most - least) / (high - low)[:, None, None].clamp(min=1e-6)
        ratio = ratio.clamp(1 / _STRETCHED, _STRETCHED)  # [B, H, Q, 3]
        stretched = (inside[:, None, None, :_POINTS] - middle[:, None, None, None]) * ratio[..., None, :]
        base = se3(rotations[:, None].expand(*sizes, 3, 3), (-(least + most) / 2).expand(*sizes, 3))
        found = register_articulated(
            shape.thinned(_POINTS),
            stretched.flatten(0, 2),
            base.flatten(0, 2),
            starts.repeat(sizes[0] * sizes[1], 1),
            _SCALES,
            _ROUNDS,
        )
        base, state, error = (value.unflatten(0, sizes) for value in found)
        error = error / ratio.mean(dim=-1)  # as large as in the cloud
        cloud, turn = (torch.arange(count, device=points.device) for count in sizes[:2])
        cloud = cloud[:, None]
        best = error.argmin(dim=2)
        base, state, error, ratio = (value[cloud, turn, best] for value in (base, state, error, ratio))
        shift = base[..., :3, 3] / ratio + middle[:, None]
        base = se3(frames.mT, torch.zeros_like(middle))[:, None] @ se3(base[..., :3, :3], shift)
        order = error.argsort(dim=1)
        return base[cloud, order], state[cloud, order]
