"""Boxes with doors are sought again, square to their own faces, with doors as far as closed.

Training shows doors that are open, as the paper's are, and users scan closed ones. There explanations failed, and not
because others fit as well: of 21 ovens that were explained wrongly, their doors less than 45 degrees open, all were
explained better by the truth, which the search had put behind others or lost (docs/experiments.md, step 274). A box
says how it is turned, up to the 24 rotations of the cube: its faces are square to the axes of its Manhattan frame. And
a box that is square has its cloud's extents, by which the category's shape is stretched before it is registered, from
each of these rotations and from joint states up to that of a closed door. Where the best of them is turned another way
than the explanation, where this has a state that training did not show, or hardly fits better than its rival, the few
that fit best take the cloud's own proportions, without which fits do not tell, and the nearest explanation wins.

Of boxes that are closed even the nearest is often wrong, as a box is one any way round; and of open ones some fit a
closed box as well, but for the door that hangs out of it. What they look like says more (`box_turns`), if that was
taught: only what looks right is tried, likeliest first, and how likely that is counts together with how near it is,
with whether its door stands as training showed, and with what the network alone says; and so is how like training
clouds the whole cloud is (`alike_boxes`), which is tried even if it looks wrong. Where explanations stand alike
and only differ in where they are hinged, how near they are tells more.

Views show too little of a box for that, and plates say nothing about which of them is which.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.box_turns import BoxTurns, Looks
from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.inference.contest import CLEARLY, Contest
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.hinge_sides import DECIDED, HingeSides
from articulate_ssl.inference.other_hinge import OtherHinge
from articulate_ssl.network.hypotheses import Hypotheses, concatenated
from articulate_ssl.shape.articulated_shape import ArticulatedShape

# All chosen on development ovens (docs/experiments.md, step 274).
_UNSURE = 0.5  # margins below
_TRIED = 6  # that take proportions; the truth is among the first five of most
_STRETCHED = 1.6  # at most, or its inverse
_POINTS, _SCALES, _ROUNDS = 128, (0.06, 0.03), 4  # of the registration
_AT_ONCE = 4  # clouds whose explanations take proportions: on a CPU, of one alone that takes three times as long
# Logarithm of how much likelier something is, by that of how much better it fits; 10 and 15 decide alike.
_FITS = 12.0
# The same of explanations that stand alike: only their doors differ; 40 decides alike (step 343).
_HINGED = 30.0
# By how much likelier, as a logarithm, a door stands as training showed it; 1.5 and 3 decide alike.
_UNSEEN = 2.0
# By how much likelier, as a logarithm, objects are turned as the network alone says; .5 decides alike, 3 worse.
_SAID = 1.0
_STANDING = 3  # ways that look rightest, in which what is hinged elsewhere is sought. Chosen.
# Of its largest extent the smallest of a box at least (bodies of the package: .66 to .83, plates: .07 and .09).
_THICK = 0.25


class _Squares(NamedTuple):
    """Of B clouds C explanations that are square to their faces, those to be tried first in front.

    Attributes:
        base: [B, C, 4, 4]
        state: [B, C, 1]
        hinge: [B, C] where they are hinged, an index of `Looks.hinges`.
        allowed: [B, C] bool, which are tried.
        looks: [B, C] how likely they are by their looks, and by what the network alone says, a logarithm.
        stood: [B, C] as which of the 24 ways they stand (`Looks.rotation`).
        own: [B] how likely what is decided for is, so.
        own_stood: [B] as which way it stands.
        least: [B] share of the error of what is decided for, that another has to be below to take its place.
    """

    base: Tensor
    state: Tensor
    hinge: Tensor
    allowed: Tensor
    looks: Tensor
    stood: Tensor
    own: Tensor
    own_stood: Tensor
    least: Tensor

    def rows(self, rows: Tensor) -> _Squares:
        """Some of the clouds."""
        return _Squares(*(one[rows] for one in self))

    def in_order(self) -> _Squares:
        """Those that are tried in front, likeliest first."""
        order = self.looks.masked_fill(~self.allowed, -torch.inf).argsort(dim=1, descending=True, stable=True)
        rows = torch.arange(len(order), device=order.device)[:, None]
        return _Squares(*(value[rows, order] for value in self[:6]), *self[6:])


class SquareSearch:
    """See above.

    Args:
        final: How explanations are fitted in the end, by a registration that says which joint states there are.
        sides: At which other sides some objects are hinged.
        turns: Which way round boxes look right.
    """

    def __init__(self, final: FinalFit, sides: HingeSides, turns: BoxTurns) -> None:
        self.final, self.sides, self.turns = final, sides, turns

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
        """Find out at which joint state the door is closed (`FinalFit.measure_closed`), where there is one."""
        if self.known:
            self.final.measure_closed()

    def sought(
        self,
        one: Hypotheses,  # H = 1, in the clouds' proportions
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        dense: Tensor | None,  # [B, P, 3]
        said: Tensor | None = None,  # [B, 3, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Explanations, or those square to the clouds' faces that fit better, or look right.

        Args:
            said: How the network alone turns objects (`Candidates.said`), if it was asked.
        """
        if not self.known or dense is None:
            return one, rival, margin
        frames, _ = manhattan_frames(dense, torch.Generator().manual_seed(0), whole=True)  # of clouds
        squares, asked = self._squares(one, margin, points, frames)
        if not self.turns.learnt:
            rows = asked.nonzero()[:, 0]
            return self._tried(rows, squares.rows(rows), one, rival, margin, points, dense)
        looks = self.turns.looks(dense, frames, *self._hinges())
        rows = self._doubted(one, asked, looks, said).nonzero()[:, 0]
        if len(rows):
            some = one.rows(rows), looks.rows(rows), points[rows], frames[rows], None if said is None else said[rows]
            squares = self._looking_right(squares.rows(rows), *some)
            one, rival, margin = self._tried(rows, squares, one, rival, margin, points, dense)
        confirmed = looks.decided & (looks.of(one.base[..., :3, :3])[1][:, 0] > -DECIDED)
        sure = 2 * looks.likely.amax(dim=1).exp() - 1
        return one, rival, torch.where(confirmed, margin.maximum(sure), margin)

    def _squares(
        self,
        one: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        frames: Tensor,  # [B, 3, 3] of the clouds
    ) -> tuple[_Squares, Tensor]:  # , [B] bool
        """What may take the place of explanations, by how well it fits, and which explanations are doubted."""
        states, shape = self.final.registration.states, self._shape()
        axes = self.final.part_frames.axes[shape.joints.chain.root]
        rotations = rotation_group(24).elements.to(points) @ axes.mT
        base, state, error = self._square(points, frames, rotations.expand(len(points), -1, -1, -1), shape)
        order = error.argsort(dim=1)
        rows = torch.arange(len(order), device=order.device)[:, None]
        base, state = base[rows, order], state[rows, order]
        showed = states.showed(one.state[:, 0])
        another = angle_to(one.base[..., :3, :3], base[:, 0, :3, :3])[:, 0] > ANOTHER_WAY
        every, least = torch.ones_like(state[..., 0], dtype=torch.bool), torch.where(showed, CLEARLY, 1.0)
        alike, none = torch.zeros_like(state[..., 0]), torch.zeros_like(every, dtype=torch.long)
        squares = _Squares(base, state, none, every, alike, none, alike[:, 0], none[:, 0], least)
        return squares, ~showed | another | (margin < _UNSURE)

    def _doubted(
        self,
        one: Hypotheses,  # H = 1
        asked: Tensor,  # [B] bool, by how well what is square fits
        looks: Looks,
        said: Tensor | None,  # [B, 3, 3]
    ) -> Tensor:  # [B] bool
        """Which explanations are doubted, where looks say how they are turned."""
        most = looks.of(one.base[..., :3, :3])[0][:, 0]
        asked = torch.where(looks.decided, ~self.final.registration.states.showed(one.state[:, 0]), asked)
        asked |= (most <= -DECIDED) | (looks.like_others(one.base[..., :3, :3])[:, 0] <= -DECIDED)
        return asked if said is None else asked | (angle_to(one.base[..., :3, :3], said)[:, 0] > ANOTHER_WAY)

    def _looking_right(
        self,
        squares: _Squares,
        one: Hypotheses,  # H = 1, what is decided for
        looks: Looks,
        points: Tensor,  # [B, N, 3]
        frames: Tensor,  # [B, 3, 3] of the clouds
        said: Tensor | None,  # [B, 3, 3]
    ) -> _Squares:
        """Those that look right, likeliest first. How right they look counts as fits do, and so does what was said.

        What stands as looks say may be hinged elsewhere.
        """
        states = self.final.registration.states
        own, own_stood = (value[:, 0] for value in looks.of(one.base[..., :3, :3])[2:])
        found = [(squares.base, squares.state, *looks.standing(squares.base[..., :3, :3]))]
        if len(looks.hinges) > 1:
            right, ways = looks.likely.topk(_STANDING, dim=1)
            rows = torch.arange(len(ways), device=ways.device)[:, None]
            rotations = frames[:, None] @ looks.rotation[rows, ways]
            right = right - right[:, :1]
            for index in range(1, len(looks.hinges)):
                shape = self._other_hinge(index).shape(self._shape())
                base, state, _ = self._square(points, frames, rotations, shape)
                found.append((base, state, right, ways))
        base, state, right, stood = (torch.cat(some, dim=1) for some in zip(*found, strict=True))
        hinge = torch.cat([torch.full_like(some[3], index) for index, some in enumerate(found)], dim=1)
        # Registration may leave a closed door open: all are tried with it closed, too.
        closed = states.rest.to(state).expand_as(state)
        base, right, stood, hinge = (torch.cat([value] * 2, dim=1) for value in (base, right, stood, hinge))
        state = torch.cat([state, closed], dim=1)
        # What the network says is as if all were hinged as most are: what is hinged elsewhere lies. So it does for
        # training clouds, if its door is open; nearly closed, it is as like those that stand.
        lying = base[..., :3, :3] @ looks.hinges[hinge]
        alike = looks.like_others(base[..., :3, :3]).maximum(looks.like_others(lying))
        likely, own = right + looks.log_prior[hinge] + alike, own + looks.like_others(one.base[..., :3, :3])[:, 0]
        if said is not None:
            likely = likely + _as_said(lying, said)
            own = own + _as_said(one.base[..., :3, :3], said)[:, 0]
        allowed, least = right.maximum(alike) > -DECIDED, torch.ones_like(squares.least)
        return _Squares(base, state, hinge, allowed, likely, stood, own, own_stood, least).in_order()

    def _tried(
        self,
        doubted: Tensor,  # [b]
        squares: _Squares,  # of these
        one: Hypotheses,  # H = 1
        rival: Hypotheses,  # H = 1
        margin: Tensor,  # [B]
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3]
    ) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
        """Explanations, or what fits better, once it has the clouds' proportions."""
        for own in torch.arange(len(doubted)).to(doubted).split(_AT_ONCE) if len(doubted) else ():
            rows, some = doubted[own], squares.rows(own)
            start = one.rows(rows)
            errors, fits = self._fits(some, start, points[rows], dense[rows])
            contest = Contest(start, rival.rows(rows), margin[rows], errors, self._as_rival)
            for which, tried, error, allowed in fits:
                tried = contest.one.with_rows(which, tried)
                error = torch.full_like(some.least, torch.inf).index_copy(0, which, error)
                allowed = torch.zeros_like(error, dtype=torch.bool).index_copy(0, which, allowed)
                contest, _ = contest.against(tried, error, allowed, some.least)
            one, rival = one.with_rows(rows, contest.one), rival.with_rows(rows, contest.rival)
            margin = margin.index_copy(0, rows, contest.margin)
        return one, rival, margin

    def _fits(
        self,
        squares: _Squares,  # of b clouds
        start: Hypotheses,  # H = 1
        points: Tensor,  # [b, N, 3]
        dense: Tensor,  # [b, P, 3]
    ) -> tuple[Tensor, Iterator[tuple[Tensor, Hypotheses, Tensor, Tensor]]]:  # [b], of [n], H = 1, [n], [n] bool
        """Errors of what was decided for; and what is tried, in proportion, what comes first before.

        Returns:
            Errors; of which clouds that is which is tried, its error, and whether it may win.
        """
        final, states = self.final, self.final.registration.states
        cloud, rank = squares.allowed[:, :_TRIED].nonzero().unbind(dim=1)
        tried = final.articulated.category_at(squares.base[cloud, rank, None], squares.state[cloud, rank, None])
        tried = self._in_proportion(tried, squares.hinge[cloud, rank], points[cloud], dense[cloud])
        allowed = states.contains(tried.state[:, 0])
        error, own = final.distance(tried, points[cloud]), final.distance(start, points)
        if self.turns.learnt:
            stood = squares.stood[cloud, rank]
            least = _least_alike(own, squares.own_stood, error.where(allowed, torch.inf), cloud, stood)
            error = self._as_likely(error, least[cloud, stood].minimum(error), squares.looks[cloud, rank], tried)
            own = self._as_likely(own, least.gather(1, squares.own_stood[:, None])[:, 0], squares.own, start)
        ranks = ((rank == k).nonzero()[:, 0] for k in rank.unique().tolist())
        return own, ((cloud[some], tried.rows(some), error[some], allowed[some]) for some in ranks)

    def _as_likely(
        self,
        error: Tensor,  # [b]
        least: Tensor,  # [b] of those that stand alike
        looks: Tensor,  # [b] logarithms
        of: Hypotheses,  # H = 1
    ) -> Tensor:  # [b]
        """Errors, as much larger as what has them is less likely, by looks, and by others that stand alike."""
        shown = self.final.registration.states.showed(of.state[:, 0])
        unlikely = torch.where(shown, 0.0, _UNSEEN) - looks + (_HINGED - _FITS) * (error / least).log()
        return error * (unlikely / _FITS).exp()

    def _in_proportion(
        self,
        tried: Hypotheses,  # H = 1
        hinge: Tensor,  # [n] where they are hinged, an index of `Looks.hinges`
        points: Tensor,  # [n, N, 3]
        dense: Tensor,  # [n, P, 3]
    ) -> Hypotheses:  # H = 1
        """What is tried, in the clouds' proportions, hinged where it is."""
        several, order = [], []
        for index in hinge.unique().tolist():
            rows = (hinge == index).nonzero()[:, 0]
            some, other = tried.rows(rows), self._other_hinge(index)
            some = some if other is None else self.final.hinged_at(some, other)
            several.append(self.final.in_proportion(some, points[rows], dense[rows], other))
            order.append(rows)
        return concatenated(several).rows(torch.cat(order).argsort())

    def _hinges(self) -> tuple[Tensor, Tensor]:  # [W, 3, 3], [W]
        """Turns about a door's normal, of hinges that are elsewhere than most, and logarithms of how many are so.

        The turns are in canonical space, the other way round than explanations are turned that lie (`HingeSides`); none
        comes first.
        """
        sides = self.sides
        ways = len(sides.quarters) if sides.learnt else 1
        return sides.hinges[:ways], sides.log_prior[:ways]

    def _other_hinge(self, index: int) -> OtherHinge | None:
        """One that is elsewhere than most, an index of `_hinges`."""
        if not index:
            return None
        return self.final.hinge(self._hinges()[0][index], self.sides.axes)

    def _shape(self) -> ArticulatedShape:
        return self.final.articulated.category.articulated_shape(REVOLUTE)

    def _as_rival(self, one: Hypotheses) -> Hypotheses:
        """The category's own shape, as rivals have it, where an explanation has that which clouds have in common.

        What is hinged elsewhere lies as if it were hinged as most are.
        """
        if not self.sides.learnt:
            return self.final.articulated.category_at(one.base, one.state)
        turn = self.sides.hinges[self.sides.hinged(one.axis[:, 0, 0])]
        middle = one.object_shape()[:, one.chain.root].mean(dim=1)
        base = one.base.clone()
        base[:, 0, :3, :3] = base[:, 0, :3, :3] @ turn
        base[:, 0, :3, 3] += (one.base[:, 0, :3, :3] @ (middle - (turn @ middle[..., None])[..., 0])[..., None])[..., 0]
        return self.final.articulated.category_at(base, one.state)

    def _square(
        self,
        points: Tensor,  # [B, N, 3]
        frames: Tensor,  # [B, 3, 3] of the clouds
        rotations: Tensor,  # [B, H, 3, 3] canonical object space -> these frames
        shape: ArticulatedShape,
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, H, 4, 4], [B, H, 1], [B, H]
        """Base poses and joint states of registrations from rotations, and their errors."""
        states = self.final.registration.states
        starts, closed = states.starts().to(points), states.rest.to(points)[None]
        starts = torch.cat([closed, closed + (starts[:1] - closed) / 4, starts])  # [Q, 1]
        sizes = len(points), rotations.shape[1], len(starts)

        posed = shape.posed(torch.eye(4).to(points).expand(len(starts), 4, 4), starts)
        turned = torch.einsum("bhij,qtj->bhqti", rotations, posed)
        least, most = turned.amin(dim=3), turned.amax(dim=3)
        inside = points @ frames.mT
        low, high = inside.amin(dim=1), inside.amax(dim=1)
        middle = (low + high) / 2
        # The cloud takes the shape's extents: that is registered rigidly then.
        ratio = (most - least) / (high - low)[:, None, None].clamp(min=1e-6)
        ratio = ratio.clamp(1 / _STRETCHED, _STRETCHED)  # [B, H, Q, 3]
        stretched = (inside[:, None, None, :_POINTS] - middle[:, None, None, None]) * ratio[..., None, :]
        base = se3(rotations[:, :, None].expand(*sizes, 3, 3), -(least + most) / 2)
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
        return base, state, error


def _as_said(
    turn: Tensor,  # [B, C, 3, 3]
    said: Tensor,  # [B, 3, 3]
) -> Tensor:  # [B, C]
    """How much likelier than others what is turned as was said is, a logarithm."""
    return torch.where(angle_to(turn, said) < ANOTHER_WAY, _SAID, 0.0)


def _least_alike(
    own: Tensor,  # [b]
    own_stood: Tensor,  # [b]
    error: Tensor,  # [n]
    cloud: Tensor,  # [n]
    stood: Tensor,  # [n]
) -> Tensor:  # [b, 24]
    """Of each cloud the least error of what stands each way, infinite where nothing does."""
    least = torch.full((len(own), 24), torch.inf).to(own)
    least = least.scatter(1, own_stood[:, None], own[:, None]).flatten()
    return least.scatter_reduce(0, 24 * cloud + stood, error, "amin").view(len(own), 24)
