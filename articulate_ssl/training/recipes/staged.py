"""The staged recipe: part discovery by registration, then the network on what that found, then on all clouds.

1. *Discovery* (`discovery.discover`) on some training clouds, before the first step. What it found is handed over
   whole: shape and joints become the category's, and the clouds that fit best are kept with their registrations. In the
   multi-state setting objects are found from all their clouds (`discovery.grouped`), also for depth views, if some
   objects were scanned from all sides (`discovery.from_scans`).
2. *Warm-up*: these clouds, turned afresh, with known poses. The category's shapes and joints are held.
3. *Self-supervision*: any training cloud, by reconstruction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.discovery.discover import discover
from articulate_ssl.discovery.from_scans import StandingScans, discover_from_scans
from articulate_ssl.discovery.grouped import discover_grouped
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS
from articulate_ssl.discovery.own_scans import by_own_scans
from articulate_ssl.discovery.parallel_axes import with_parallel_axes
from articulate_ssl.discovery.proposals import load_proposals
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.candidates import Iteration
from articulate_ssl.losses.objective import PoseTarget, staged_terms
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.ranks import own_rows, world
from articulate_ssl.shape.observation import Observation
from articulate_ssl.training.lying_scans import quarters_to_stand
from articulate_ssl.training.recipes.recipe import Outcome, Recipe, TrainingClouds

# Registration that teaches, in every step: shorter than at test time. Chosen, not measured.
_SCALES, _ROUNDS = (0.04, 0.02), 4
_ALL = 10**6  # scans: more than anybody has


@dataclass(frozen=True)
class HandOver:
    """What discovery hands over besides the category's shape: n clouds and how the shape is in each.

    Attributes:
        points: [n, N, 3].
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J] joint states.
        log_stretch: [n, K, 3] of every part along its principal axes.
        limits: [J, 2] between which joint states lie.
        point_part: [n, N] which part every point belongs to, where discovery says it: of simulated views.
    """

    points: Tensor
    base: Tensor
    state: Tensor
    log_stretch: Tensor
    limits: Tensor
    point_part: Tensor | None = None


class TrainingRecipe(Recipe):
    """See above. The learning rate falls along a cosine."""

    # L_reg pulls siblings that lie side by side together as gladly as part and parent: of four parts, it made another
    # tree of the one that discovery had found, whose joints nothing had trained.
    learns_tree = False

    def __init__(self, *args) -> None:
        super().__init__(*args)
        # What makes no sense is to be told before anything runs.
        load_proposals(self.discovery.proposals)
        if self.discovery.grouped:
            _check_setting(self.estimator.observation)
        self.found: HandOver | None = None
        self._scans: StandingScans | None = None
        self._shown: Tensor | None = None  # objects of all scans that discovery was given
        self._hinged: StandingScans | None = None
        self.group = rotation_group(len(self.estimator.articulated.pose_head.elements))

    @property
    def cheap_steps(self) -> int:
        """Stage 0 and the warm-up: no registration in every step."""
        return self._warm

    @property
    def multi_state(self) -> bool:
        """Where part discovery does."""
        return self.discovery.grouped

    @property
    def ready(self) -> bool:
        """After discovery."""
        return self.found is not None

    def prepare(self, data: TrainingClouds, num_points: int) -> None:
        """Part discovery."""
        network = self.estimator.articulated
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            clouds, found = self._discovered(data, num_points)
            found = found.in_the_trees_order()
            if network.shared_axis and network.num_parts > 2:
                found = with_parallel_axes(found, clouds, self.discovery)
        # All simulated views are of clouds that fit well.
        kept = slice(None) if self._simulated else found.best(self.discovery.kept(len(clouds)))
        registered = found.of_clouds(kept)
        self.found = HandOver(
            clouds[kept, :num_points],
            registered.base,
            registered.state,
            registered.log_stretch,
            found.limits(),
            None if registered.point_part is None else registered.point_part[:, :num_points],
        )
        network.category.adopt(found.shape)
        if self._simulated:
            said = registered.base, registered.state, registered.point_part, registered.quarters
            self.estimator.view_search.learn(clouds, *said)
        if found.axes is not None and not self._simulated:  # in a frame that the clouds share
            shape = network.category.articulated_shape(network.joint_type)
            self.estimator.sliding.learn(shape, found.limits(), clouds[kept], registered.base, found.labelled)

    def _discovered(self, data: TrainingClouds, num_points: int) -> tuple[Tensor, RegisteredShape]:
        """Training clouds [n, N, 3], or views that were simulated, and the category's shape registered to them."""
        options, network, observation = self.discovery, self.estimator.articulated, self.estimator.observation
        clouds, category = data.clouds(options.clouds), (network.num_parts, network.joint_type, options)
        if options.grouped:
            # Where parts slide, more objects are looked at.
            whole = options.objects * MIN_CLOUDS if network.joint_type == PRISMATIC else 0
            objects = data.objects(max(options.clouds, whole))
        if self._simulated:
            scans, self._shown = data.scans(options.clouds)
            found_in = (scans, *objects, *category, observation.orientation, num_points)
            *simulated, scans = discover_from_scans(clouds, *found_in, to_stand=quarters_to_stand)
            self._scans = replace(scans, found=scans.found.in_the_trees_order())
            return tuple(simulated)
        if options.grouped:
            return clouds, discover_grouped(clouds, *objects, *category)
        return clouds, discover(clouds, *category, observation)

    def standing_scans(self, data: TrainingClouds, num_points: int) -> StandingScans:
        """Scans that taught views, as discovery stood them up, of one joint with hinges of their own.

        They are found anew where that was in another run.
        """
        if self._hinged is None:
            with torch.random.fork_rng(devices=[]):
                if self._scans is None:
                    self._discovered(data, num_points)
                scans = self._scans
                instance = torch.where(scans.source < 0, -1, self._shown[scans.source.clamp(min=0)])
                shown = scans.clouds, instance, *data.objects(_ALL)
                self._hinged = replace(scans, found=by_own_scans(scans.found, *shown, self.discovery))
        return self._hinged

    def step(self, points: Tensor, step: int, generator: Callable[[], torch.Generator]) -> Outcome:
        """Warm-up or self-supervision."""
        if step < self._warm:
            return self._warmup_step(points, generator())
        return self._self_supervised_step(points)

    def network_rate(self, step: int) -> float:
        """From 1 to `final_rate` along half a cosine."""
        s = self.schedule
        return s.final_rate + (1 - s.final_rate) * 0.5 * (1 + math.cos(math.pi * min(step / s.steps, 1)))

    def category_rate(self, step: int) -> float:
        """Shapes and joints are held during the warm-up."""
        return 0.0 if step < self._warm else self.schedule.category_rate * self.network_rate(step)

    def kept(self) -> dict[str, Tensor | None] | None:
        """The registered clouds, so that training resumes without discovery."""
        return None if self.found is None else asdict(self.found)

    def restore(self, kept: dict[str, Tensor | None] | None) -> None:
        """Take them back."""
        self.found = None if kept is None else HandOver(**kept)

    @property
    def _warm(self) -> int:
        return self.schedule.rigid_steps + self.schedule.warmup_steps

    @property
    def _simulated(self) -> bool:
        """Whether views of scans teach, which show what a camera sees: turned, they would show something else."""
        return self.discovery.grouped and self.estimator.observation.unidirectional

    def _warmup_step(self, points: Tensor, generator: torch.Generator) -> Outcome:
        """Registered clouds, turned afresh or simulated: poses are known, so the hypothesis nearest to them trains."""
        aligned, target = self._registered_clouds(len(points), generator, points.device)
        category, trained = self.estimator.articulated.category.canonical(), []
        for iteration in self.estimator.iterate(aligned):
            still = torch.eye(3, device=points.device)
            start = still if iteration.start is None else iteration.start.base[:, 0, :3, :3]
            nearest = self.group.nearest(start.transpose(-1, -2) @ target.base[:, :3, :3])
            selected = iteration.hypotheses.select(nearest)
            terms = staged_terms(selected, aligned, category, self.objective, target, follow_category=True)
            trained.append((terms, selected))
        return Outcome.of(trained)

    def _registered_clouds(
        self, size: int, generator: torch.Generator, device: torch.device
    ) -> tuple[Tensor, PoseTarget]:
        """A batch of them, in random orientations, aligned [B, N, 3], and where the shape is in each."""
        orientation = self.estimator.observation.orientation
        of_all, _ = world()
        index = own_rows(torch.randint(len(self.found.points), (of_all * size,), generator=generator))
        rotation = own_rows(orientation.draw(of_all * size, generator)).to(device)
        points, base, state = (
            value[index].to(device) for value in (self.found.points, self.found.base, self.found.state)
        )
        if self._simulated:
            rotation = torch.eye(3).to(rotation).expand_as(rotation)
        elif orientation.limited:
            rotation = rotation @ base[:, :3, :3].mT  # to an orientation within the range
        turn = se3(rotation, rotation.new_zeros(size, 3))
        aligned, pose = self.estimator.align(transform_points(turn, points))
        part = None if self.found.point_part is None else self.found.point_part[index].to(device)
        return aligned, PoseTarget(invert_se3(pose) @ turn @ base, state, part)

    def _self_supervised_step(self, points: Tensor) -> Outcome:
        """The best reconstruction of any cloud trains, drawn to where a few rounds of registration move it."""
        aligned, _ = self.estimator.align(points)
        category, trained = self.estimator.articulated.category.canonical(), []
        for iteration in self.estimator.iterate(aligned):
            winner = iteration.winner
            selected = iteration.hypotheses.select(winner)
            target = self._registered(iteration, winner, selected) if self.objective.distillation else None
            terms = staged_terms(selected, aligned, category, self.objective, target, follow_category=False)
            trained.append((terms, selected))
        return Outcome.of(trained)

    def _registered(self, iteration: Iteration, winner: Tensor, selected: Hypotheses) -> PoseTarget:
        """Where registration moves the winner [B], if that is better; else where it is."""
        moved = self.estimator.registration.register(selected, iteration.points, _SCALES, _ROUNDS)
        base, state, after = (value[:, 0] for value in moved)
        better = after < iteration.distance.gather(1, winner[:, None])[:, 0]
        return PoseTarget(
            torch.where(better[:, None, None], base, selected.base[:, 0].detach()),
            torch.where(better[:, None], state, selected.state[:, 0].detach()),
        )


def _check_setting(observation: Observation) -> None:
    """Whole objects are found from complete clouds; views of them show some of their sides.

    Raises:
        ValueError: for views whose hidden sides would count.
    """
    if observation.orientation.limited and not observation.unidirectional:
        raise ValueError(
            "discovery.grouped finds shapes with all their sides, of which a depth view (orientation_range below 180) "
            "shows some: add objective.unidirectional true (-c configs/profiles/depth_from_scans.yaml), or leave "
            "grouped out"
        )
