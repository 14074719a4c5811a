"""What is learnt after the last step, without labels: which lessons there are, in which order, by how many clouds.

What decides and measures in the end, and how far predictions can be trusted, is learnt from explanations of training
clouds, so it comes after the networks that explain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.training.alike_lesson import learn_alike_boxes
from articulate_ssl.training.box_lessons import learn_box_turns
from articulate_ssl.training.closed_door_lesson import learn_closed_doors
from articulate_ssl.training.contact_lesson import learn_closed_contact
from articulate_ssl.training.explanations import learn_handedness, learn_two_ways
from articulate_ssl.training.frame_lessons import learn_part_frames
from articulate_ssl.training.hinge_lessons import learn_hinge_sides
from articulate_ssl.training.joint_limits import learn_joint_limits
from articulate_ssl.training.object_lessons import learn_objects
from articulate_ssl.training.pose_lessons import learn_poses
from articulate_ssl.training.self_agreement import learn_confidence
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.standing_lesson import learn_standing_part
from articulate_ssl.training.turn_lessons import learn_turns, learn_view_turns
from articulate_ssl.training.view_look_lesson import learn_view_looks

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

# Each reads what those before it have learnt. Joint limits come first, as what is explained beyond them must not teach,
# and again when it is known how faces lie: that moves states.
LESSONS = (
    *("first_limits", "two_ways", "turns", "objects", "handedness", "part_frames", "view_turns", "hinge_sides"),
    *("joint_limits", "closed_contact", "closed_doors", "view_looks", "poses", "alike_boxes", "box_turns"),
    *("standing_part", "confidence"),
)


class Lesson(NamedTuple):
    """Of a module as it is now.

    Attributes:
        learn: What teaches it, `learn(module, clouds)`.
        samples: Training clouds that it reads, or views that it simulates; 0 where it does not apply.
        of_objects: Whether it reads all clouds of objects, `learn(module, clouds, objects)`.
        of_scans: Whether it reads what discovery did, `learn(module, training_clouds)`.
    """

    learn: Callable[..., None]
    samples: int
    of_objects: bool = False
    of_scans: bool = False


def teach(
    module: ArticulatedPoseModule, training_clouds: SetClouds, lessons: Sequence[str] = LESSONS
) -> tuple[str, ...]:
    """Teach lessons, each on top of what was learnt before.

    Args:
        training_clouds: Of which a fixed subset teaches each lesson.
        lessons: Which of `LESSONS`; they are taught in that order.

    Returns:
        Those that apply.
    """
    training = module.training
    module.eval()
    taught = []
    for name in (name for name in LESSONS if name in lessons):
        lesson = plan(module)[name]
        if not lesson.samples:
            continue
        if lesson.of_scans:
            lesson.learn(module, training_clouds)
        else:
            shown = training_clouds.objects if lesson.of_objects else lambda samples: (training_clouds.clouds(samples),)
            lesson.learn(module, *(some.to(module.device) for some in shown(lesson.samples)))
        taught.append(name)
    module.train(training)
    return tuple(taught)


def plan(module: ArticulatedPoseModule) -> dict[str, Lesson]:
    """Every lesson by its name, as it applies to what the module has learnt so far."""
    turns, refines = module.articulated.joint_type == REVOLUTE, bool(module.inference.refine)
    views, any_way = module.view_search.learnt, not module.orientation.limited
    # Where the frames of the collection have said which way round clouds are, nothing is left to decide.
    decides = refines and any_way and not module.sliding.learnt
    calibration, two_ways = module.calibration_samples, module.two_ways_samples
    labelled = len(module.sliding.labelled)  # clouds of the objects that discovery understood
    doors = turns and refines and views and module.num_parts == 2
    limits = Lesson(learn_joint_limits, calibration if refines and turns else 0)
    return {
        "first_limits": limits,
        "two_ways": Lesson(learn_two_ways, two_ways if decides else 0),
        "turns": Lesson(learn_turns, two_ways if refines and any_way and module.sliding.learnt else 0),
        "objects": Lesson(learn_objects, module.object_samples if refines and labelled else 0, of_objects=True),
        "handedness": Lesson(learn_handedness, 0 if any_way else module.handedness_samples),
        "part_frames": Lesson(learn_part_frames, module.part_frames_samples if refines and (turns or views) else 0),
        "view_turns": Lesson(learn_view_turns, two_ways if refines and views else 0),
        "hinge_sides": Lesson(learn_hinge_sides, module.hinge_sides_samples if refines else 0),
        "joint_limits": limits,
        "closed_contact": Lesson(learn_closed_contact, calibration if refines and turns and any_way else 0),
        "closed_doors": Lesson(learn_closed_doors, module.closed_views_samples if doors else 0, of_scans=True),
        "view_looks": Lesson(learn_view_looks, module.view_looks_samples if doors else 0, of_scans=True),
        "poses": Lesson(learn_poses, module.pose_samples if refines and turns else 0),
        "alike_boxes": Lesson(learn_alike_boxes, module.alike_boxes_samples if refines and turns and any_way else 0),
        "box_turns": Lesson(learn_box_turns, module.box_turns_samples if refines and turns and any_way else 0),
        "standing_part": Lesson(learn_standing_part, 0 if any_way else calibration),
        "confidence": Lesson(learn_confidence, calibration),
    }
