"""A category's articulated shape, registered to clouds: what part discovery finds and hands over."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.geometry.orientation_range import mean_rotation
from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import category_chain

# Joint limits: where nine tenths of the clouds' states lie, and a margin for what few clouds show.
_LIMIT_QUANTILES = (0.05, 0.95)
_LIMIT_MARGIN = 0.15  # of the width between them, on either side
# A state is at an end of what was sought if it is nearer to it than this share of the width. Of scans of washing
# machines and ovens that were explained wrongly most are there, of the others none (docs/experiments.md, step 321);
# from .01 to .06 it was nearly the same.
_AT_END = 0.03
_MOST_AT_END = 0.5  # of the clouds: were it more, what was sought would be too narrow. Chosen.
_OF_CLOUDS = ("base", "state", "log_stretch", "error", "beside", "point_part", "quarters")


@dataclass(frozen=True)
class RegisteredShape:
    """A shape and, for n clouds, where and how it is in each.

    Canonical object space has the template's principal axes as coordinate axes, so that the half-turns under which an
    object nearly maps to itself are elements of the rotation group; where orientations are limited, it is turned as the
    clouds are in the mean. State zero of every joint is near the clouds' mean.

    Attributes:
        shape: Points, labels and joints.
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J] joint states.
        log_stretch: [n, K, 3] of every part along its principal axes (`shape.stretch`).
        error: [n] distance of every cloud to its reconstruction, stretched to its proportions (`InstanceFit.error`).
        axes: [K, 3, 3] columns along which parts stretch, where these are not their principal axes: the axes of the
            frame that clouds have in common.
        beside: [n, K, 3] where else parts of each cloud lie, in canonical object space, where they may.
        point_part: [n, N] which part every point of the clouds belongs to, where more than the shape says it.
        labelled: What said it: clouds of whole objects, which stand as canonical object space does.
        sought: [J, 2] between which joint states were sought, farther than they were seen to go: the door of a cloud
            that is explained otherwise than it is, is mostly where it is least in the way, at an end of this.
        quarters: [n] by how many quarters about the closed door's normal objects are turned until they stand, where
            canonical space lays hinges over each other and bodies tell (`from_scans`).
    """

    shape: ArticulatedShape
    base: Tensor
    state: Tensor
    log_stretch: Tensor
    error: Tensor
    axes: Tensor | None = None
    beside: Tensor | None = None
    point_part: Tensor | None = None
    labelled: LabelledClouds | None = None
    sought: Tensor | None = None
    quarters: Tensor | None = None

    @staticmethod
    def of(fit: InstanceFit, clouds: Tensor) -> RegisteredShape:
        """What an instance fit says about its clouds [n, N, 3]."""
        error = fit.error(clouds, softened=False)
        return RegisteredShape(fit.shape, fit.base, fit.state, fit.log_stretch, error, fit.axes, fit.beside)

    def of_clouds(self, rows: Tensor | slice) -> RegisteredShape:
        """The same for some of the clouds."""
        own = {name: getattr(self, name) for name in _OF_CLOUDS}
        return replace(self, **{name: value[rows] for name, value in own.items() if value is not None})

    def fit(self, generator: torch.Generator, rows: Tensor | slice = slice(None)) -> InstanceFit:
        """An instance fit to go on from here, on some of the clouds; stretches along principal axes start anew."""
        own = self.of_clouds(rows)
        start = None if self.axes is None else own.log_stretch
        return InstanceFit(self.shape, own.base, own.state, generator, self.axes, start, own.beside)

    @property
    def inside(self) -> Tensor:
        """[n] whether no joint is at an end of what was sought; all, if most are, or nothing is known of it."""
        everywhere = torch.ones(len(self.state), dtype=torch.bool, device=self.state.device)
        if self.sought is None:
            return everywhere
        low, high = self.sought.to(self.state).unbind(-1)
        end = _AT_END * (high - low)
        inside = ((self.state > low + end) & (self.state < high - end)).all(dim=1)
        return inside if (~inside).double().mean() <= _MOST_AT_END else everywhere

    def best(self, count: int) -> Tensor:
        """Of so many clouds that fit best, those that are `inside`, the best first."""
        best = self.error.argsort()[:count]
        return best[self.inside[best]]

    def limits(self) -> Tensor:
        """[J, 2] between which joint states lie, as far as clouds show that are not at an end of what was sought."""
        return state_limits(self.state[self.inside])

    def limited(self) -> ArticulatedShape:
        """The shape with limits to seek between: of all states, as what was sought before may have been too narrow."""
        return replace(self.shape, joints=replace(self.shape.joints, limits=state_limits(self.state)))

    def in_the_trees_order(self) -> RegisteredShape:
        """The same, named as the tree of a category with these joints is (`category_chain`), which poses are told by.

        Of two parts the first is the base: if the second is, they exchange names. Joints come in the tree's order.
        """
        found, chain = self, self.shape.joints.chain
        tree = category_chain(chain)
        if chain.num_parts == 2 and chain.root != tree.root:
            found, chain = self._with_names_exchanged(), tree
        order, joints = [chain.child.index(child) for child in tree.child], found.shape.joints
        limits = None if joints.limits is None else joints.limits[order]
        joints = replace(joints, chain=tree, axis=joints.axis[order], pivot=joints.pivot[order], limits=limits)
        sought = None if found.sought is None else found.sought[order]
        return replace(found, shape=replace(found.shape, joints=joints), state=found.state[:, order], sought=sought)

    def _with_names_exchanged(self) -> RegisteredShape:
        """Of two parts each has the other's name; the tree is as it was."""
        axes, beside, part, labelled = self.axes, self.beside, self.point_part, self.labelled
        return replace(
            self,
            shape=replace(self.shape, label=1 - self.shape.label),
            log_stretch=self.log_stretch.flip(1),
            axes=None if axes is None else axes.flip(0),
            beside=None if beside is None else beside.flip(1),
            point_part=None if part is None else 1 - part,
            labelled=None if labelled is None else labelled._replace(part=1 - labelled.part),
        )

    def turned_to_mean(self) -> RegisteredShape:
        """The same with the canonical space turned as the clouds are in the mean."""
        return self.turned(mean_rotation(self.base[:, :3, :3]))

    def with_parallel_axes(
        self,
        direction: Tensor,  # [3]
    ) -> RegisteredShape:
        """The same with all joints along one direction, each in its own sense; states follow as well as they can."""
        joints = self.shape.joints
        axis = (joints.axis @ direction).sign()[:, None] * direction
        shape = replace(self.shape, joints=replace(joints, axis=axis))
        state = shape.read_states(joints.part_pose(self.base, self.state))
        return replace(self, shape=shape, state=state, sought=None)

    def turned(
        self,
        rotation: Tensor,  # [3, 3]
    ) -> RegisteredShape:
        """The same with the canonical space turned."""
        turn = se3(rotation, rotation.new_zeros(3))
        axes = None if self.axes is None else rotation @ self.axes
        beside = None if self.beside is None else self.beside @ rotation.mT
        base = self.base @ invert_se3(turn)
        return replace(self, shape=self.shape.in_frame(turn), base=base, axes=axes, beside=beside, labelled=None)


def state_limits(
    state: Tensor,  # [n, J]
) -> Tensor:  # [J, 2]
    """Between which joint states lie, as far as n clouds show, of which some may be wrong."""
    low, high = torch.quantile(state, torch.tensor(_LIMIT_QUANTILES).to(state), dim=0)
    margin = _LIMIT_MARGIN * (high - low)
    return torch.stack([low - margin, high + margin], dim=-1)


def trimmed_mean(error: Tensor, options: DiscoveryOptions) -> float:
    """Mean of the errors that count: some clouds are aligned wrongly."""
    return float(error.sort().values[: options.kept(len(error))].mean())
