"""How `inference.hinge_sides` is learnt: from predictions of training clouds, most of which stand as they should.

No label is read. A network is taught that objects stand right as they are predicted and wrong when they are turned, all
of them, though of ovens one in nine lies on its side. What it disagrees with is turned, and it is taught anew, twice:
it then stands more than nine in ten of the lying ovens up and turns over one in fifty others (docs/experiments.md,
step 124). If all bodies seem to stand alike, it is taught anew by doors and their mirror images, once, and each lesson
is doubted: three without doubt taught no more (step 130). In views of an upright camera nothing of that is needed.

Where objects are hinged on either side as often, there are no most: half of them are predicted upside down, and lessons
that believe that teach nothing. What doors have above they then have below as often, and which of them are the other
way up they say themselves (`upside_down`); lessons begin with that. But a latch may be above or below as it comes, and
say nothing of which side is up: so nothing is begun where bodies, in the mirror, too, stand as they are predicted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.hinge_sides import DECIDED, Bodies, HingeSides
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import registered_points, with_noise
from articulate_ssl.training.surface_lessons import FEWEST, TAUGHT, Lessons, believable, teach
from articulate_ssl.training.upside_down import upside_down

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH, _CHUNK = 16, 64
_DOUBT = 0.06  # share of the lessons about doors that may be wrong. No other was tried.
# Share of the first clouds in which enough is seen of the body, or the door, without which nothing is learnt. Chosen.
_FIRST, _KNOWN = 64, 0.9
_VIEWS = 256  # of an upright camera, from which nothing is learnt but a direction and a share. Chosen.
# Shares of the clouds that the network was not taught by. Chosen: fewer that are turned are not worth a network; more
# would mean that most are not right; and one that cannot tell sides apart is undecided of many, as a camera is mistaken
# about many simulated views.
_LEAST_TURNED, _MOST_TURNED, _MOST_UNDECIDED = 0.02, 0.4, 0.15
_RARE = 1e-3  # least share of a side
_SHARES = 50  # rounds of expectation and maximisation

log = logging.getLogger(__name__)


class _Course(NamedTuple):
    """How a network is taught which side is up: by what, how often anew, and what share of it may be wrong."""

    seen: str
    rounds: int
    doubt: float


_BODIES, _DOORS = _Course("bodies", 3, 0.0), _Course("doors", 1, _DOUBT)
_MIRRORED_BODIES = _Course("bodies and their mirror images", 1, _DOUBT)
_HALF_OF_THE_DOORS = _Course("doors, half of them upside down", 3, _DOUBT)


class _Said(NamedTuple):
    """What a network says of clouds that did not teach it: shares of what is to be turned, and of what is undecided."""

    turned: float
    undecided: float

    @property
    def decided(self) -> bool:
        return self.undecided <= _MOST_UNDECIDED

    @property
    def useful(self) -> bool:
        return self.decided and _LEAST_TURNED <= self.turned <= _MOST_TURNED


@torch.no_grad()
def learn_hinge_sides(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out whether some objects are hinged at another side than most."""
    estimator, network = module.estimator, module.articulated
    sides = estimator.hinge_sides
    sides.learnt.fill_(False)  # of a run that ended and goes on
    sides.doors.fill_(False)
    sides.camera.forget()
    sides.surface = None
    if network.num_parts != 2 or network.joint_type != REVOLUTE or TAUGHT * len(clouds) < FEWEST:
        return
    views = estimator.view_search
    if estimator.handedness.learnt or (views.learnt and not module.orientation.limited):
        return  # two hands, or simulated views, say more of which way round views are
    shape = network.category.articulated_shape(network.joint_type)
    sides.measure(shape, module.states.known, estimator.part_frames)
    if module.orientation.limited:
        if views.learnt:
            _learn_from_views(sides, views)
        else:
            _learn_upright(sides, _base_poses(module, clouds[:_VIEWS])[:, :3, :3])
        return
    predictions = _predictions(module, clouds[:_FIRST])
    if not _seen_enough(_bodies(module, clouds[:_FIRST], predictions)):
        tell(log, "hinge sides: too little is seen behind the closed door")
        return
    predictions += _predictions(module, clouds[_FIRST:])
    bodies = _bodies(module, clouds, predictions)
    if _seen_enough(bodies) and _taught(module, bodies, _BODIES).useful:
        sides.learnt.fill_(True)
        return
    sides.doors.fill_(True)
    doors = _bodies(module, clouds, predictions)
    if _seen_enough(doors):
        said = _taught(module, doors, _DOORS)
        if said.useful or (not said.decided and _half_are_upside_down(module, clouds, predictions, doors)):
            # What is upside down is a mirror image, whose door is as far from closed; and in the middle of its range.
            sides.closed.copy_(module.states.known.mean())
            sides.shut -= sides.closed
            sides.learnt.fill_(True)
            return
    sides.doors.fill_(False)
    sides.surface = None


def _half_are_upside_down(
    module: ArticulatedPoseModule, clouds: Tensor, predictions: Sequence[Prediction], doors: Bodies
) -> bool:
    """Whether doors say which of them are upside down, though none seems to be the right way up more often."""
    bodies = _bodies(module, clouds, predictions, behind=True)
    if not _seen_enough(bodies) or _taught(module, bodies, _MIRRORED_BODIES).decided:
        return False
    return _taught(module, doors, _HALF_OF_THE_DOORS, upside_down(doors)).decided


def _seen_enough(bodies: Bodies) -> bool:
    return float(bodies.known.double().mean()) >= _KNOWN


def _base_poses(module: ArticulatedPoseModule, views: Tensor) -> Tensor:
    """[n, 4, 4] canonical object space -> camera, as views are predicted."""
    return torch.cat([one.base_pose for one in _predictions(module, views)])


def _learn_upright(
    sides: HingeSides,
    rotation: Tensor,  # [n, 3, 3] canonical object space -> camera, as views are predicted
) -> None:
    """Find out which way is up for an upright camera, and whether some objects do not stand as they are predicted."""
    sides.camera.learn(rotation, sides.axes)
    if sides.camera.learnt:
        _, quarters, stand = sides.camera.stood(rotation)
        other, undecided = float((quarters > 0).double().mean()), float((~stand).double().mean())
        tell(log, "hinge sides, by an upright camera: %.0f %% lie, undecided %.0f %%", 100 * other, 100 * undecided)
        sides.learnt.fill_(_LEAST_TURNED <= other <= _MOST_TURNED and undecided <= _MOST_UNDECIDED)
    if not sides.learnt:
        sides.camera.forget()


def _learn_from_views(sides: HingeSides, views: ViewSearch) -> None:
    """The same from simulated views, of which it is known how they lie."""
    rotation, lie = views.base[:, :3, :3], views.quarters > 0
    if not lie.any():
        return
    sides.camera.learn(rotation[~lie], sides.axes)
    if sides.camera.learnt:
        mistaken = float((sides.camera.stood(rotation)[1] != views.quarters).double().mean())
        tell(log, "hinge sides, by views: %d of %d lie, mistaken %.0f %%", int(lie.sum()), len(lie), 100 * mistaken)
        sides.learnt.fill_(mistaken <= _MOST_UNDECIDED)
    if not sides.learnt:
        sides.camera.forget()


def _taught(
    module: ArticulatedPoseModule,
    bodies: Bodies,
    course: _Course,
    ways: Tensor | None = None,  # [n] way in which each looks right, for the first lesson; None: as it is predicted
) -> _Said:
    """Teach a network what looks right, and ask it of the clouds that did not teach it."""
    sides = module.estimator.hinge_sides
    known = bodies.known.nonzero()[:, 0]
    order = known[torch.randperm(len(known), generator=torch.Generator().manual_seed(0)).to(known.device)]
    count = int(TAUGHT * len(order))
    taught, rest = bodies.rows(order[:count]), bodies.rows(order[count:])
    every, steps = torch.arange(count, device=order.device)[:, None], torch.arange(len(sides.quarters)).to(order)
    halves = ways is not None
    turned = ways[order[:count], None] if halves else torch.zeros_like(every)
    for lesson in range(1, course.rounds + 1):
        frames = taught.frames[every, sides.quarters[(turned + steps) % len(steps)]]
        lessons = Lessons(taught.points, taught.surface, frames, bool(sides.doors), course.doubt)
        sides.surface = teach(lessons, f"which side is up, {lesson} of {course.rounds}", sides.size)
        if lesson < course.rounds:
            turned = _odds(module, taught).argmax(dim=1, keepdim=True)
    odds = _odds(module, rest)
    share = _shares(odds)
    believed = odds + share.log()
    best = believed.topk(2, dim=1).values
    said = _Said(float(1 - share[0]), float((best[:, 0] - best[:, 1] < DECIDED).double().mean()))
    percent = (100 * share).round().int().tolist()
    tell(log, "hinge sides, by %s: %s %% of the clouds, undecided %.0f %%", course.seen, percent, 100 * said.undecided)
    sides.log_prior.zero_()
    sides.log_prior[: len(share)] = share.log()
    if not halves:
        # As surely as what is predicted is right, which most is.
        sides.surface.temperature.copy_(believable(believed[:, 0] - believed[:, 1:].logsumexp(dim=1)))
    return said


def _predictions(module: ArticulatedPoseModule, clouds: Tensor) -> list[Prediction]:
    """Of training clouds, by batches."""
    count = registered_points(module)
    return [
        module.estimator.predict_with_rivals(some[:, :count], module.num_points, dense=some, fits=False)[0]
        for some in announced(log, "hinge sides, predictions", clouds.split(_BATCH))
    ]


def _bodies(
    module: ArticulatedPoseModule, clouds: Tensor, predictions: Sequence[Prediction], behind: bool = False
) -> Bodies:
    """What is seen of training clouds, as they are and with noise; `behind` the doors, though doors are seen."""
    sides, generator = module.estimator.hinge_sides, torch.Generator().manual_seed(0)
    shown = announced(log, "hinge sides, surfaces", clouds.split(_BATCH))

    def seen(one: Prediction, some: Tensor) -> Bodies:
        versions = some, with_noise(some, generator)
        return sides.bodies_at(one.base_pose, some, versions) if behind else sides.bodies(one, some, versions)

    return Bodies.cat(seen(one, some) for some, one in zip(shown, predictions, strict=True))


def _odds(module: ArticulatedPoseModule, bodies: Bodies) -> Tensor:
    """How right they look in each of their ways [n, W]."""
    chunks = torch.arange(len(bodies.known), device=bodies.known.device).split(_CHUNK)
    return torch.cat([module.estimator.hinge_sides.looks_right(bodies.rows(rows)) for rows in chunks])


def _shares(odds: Tensor) -> Tensor:
    """How many clouds are to be turned each way [W], by expectation maximisation."""
    share = torch.full_like(odds[0], 1 / odds.shape[1])
    for _ in range(_SHARES):
        share = (odds + share.log()).softmax(dim=1).mean(dim=0).clamp_min(_RARE)
    return share / share.sum()
