"""What the paper's recipe does beside its objective: starts, even spreads, shapes that are freed late."""

from dataclasses import replace

import pytest
import torch

from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.losses.objective import ObjectiveOptions, paper_terms
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.recipes.paper import TrainingRecipe
from articulate_ssl.training.schedule import ScheduleOptions
from tests.articulate_ssl.tiny import tiny_module


def _clouds(count: int = 8) -> torch.Tensor:
    return 0.3 * torch.randn(count, 64, 3, generator=torch.Generator().manual_seed(3))


def _first(module) -> torch.Tensor:
    """The states that the first step trains, [B, J]."""
    return module.recipe.step(_clouds(), 0, torch.Generator).selected.state[:, 0]


@pytest.mark.parametrize(("parts", "anchors"), [(2, 4), (3, 2), (4, 1)])
def test_there_are_at_most_four_combinations_of_states(parts, anchors):
    assert TrainingRecipe.state_anchors(parts) == anchors
    assert len(tiny_module(recipe="paper", num_parts=parts).articulated.pose_head.anchors) == anchors ** (parts - 1)
    assert len(tiny_module(recipe="staged", num_parts=parts).articulated.pose_head.anchors) == 1


def test_clouds_are_spread_evenly_over_the_states_at_first_only():
    options = {"recipe": "paper", "network": {"iterations": 1}, "objective": ObjectiveOptions(agreement=0.0)}
    balanced = tiny_module(**options)
    assert _first(balanced).histc(4, 0, balanced.articulated.pose_head.state_bound).tolist() == [2, 2, 2, 2]
    free = tiny_module(**options, schedule=ScheduleOptions(steps=6, balanced_share=0.0))
    best = next(free.estimator.iterate(_clouds()))
    expected = best.hypotheses.select(best.winner).state[:, 0]
    torch.testing.assert_close(_first(free), expected)
    late = balanced.recipe.step(_clouds(), 5, torch.Generator).selected.state[:, 0]
    torch.testing.assert_close(late, expected)


def test_instances_are_freed_late():
    module, freedom = tiny_module(steps=100, recipe="paper"), []
    for step in (0, 50, 55, 75, 99):
        module.recipe.step(_clouds(2), step, torch.Generator)
        freedom.append(module.articulated.shape_head.freedom)
    assert freedom == pytest.approx([0, 0, 0.2, 1, 1])
    assert tiny_module(recipe="staged").articulated.shape_head.freedom == 1


def test_slots_have_no_say_at_first():
    module, weights = tiny_module(steps=100, recipe="paper", objective=ObjectiveOptions(agreement=0.7)), []
    assert module.estimator.agreement == 0.7  # of a checkpoint's
    for step in (0, 39, 40, 99):
        module.recipe.step(_clouds(2), step, torch.Generator)
        weights.append(module.estimator.agreement)
    assert weights == [0, 0, 0.7, 0.7]
    assert tiny_module(recipe="staged").estimator.agreement == 0


def test_stage_0_does_not_count():
    """Shares are of the articulated network's steps."""
    module = tiny_module(steps=100, rigid_steps=20, recipe="paper")
    module.recipe.step(_clouds(2), 64, torch.Generator)
    assert module.articulated.shape_head.freedom == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("recipe", "asked", "registered"),
    [("paper", None, False), ("paper", True, True), ("staged", None, True), ("staged", False, False)],
)
def test_the_papers_tests_are_not_registered_unless_asked(recipe, asked, registered):
    module = tiny_module(recipe=recipe, inference=InferenceOptions(refine=asked))
    assert module.inference.refine is registered
    before, module.estimator.registration.register = (
        module.estimator.registration.register,
        _note(module.estimator.registration.register, calls := []),
    )
    module.eval().predict_points(_clouds(2))
    assert bool(calls) is registered
    module.estimator.registration.register = before


def _note(function, calls):
    def noted(*arguments):
        calls.append(1)
        return function(*arguments)

    return noted


def _selected(objective: ObjectiveOptions):
    module = tiny_module(recipe="paper", objective=objective, network={"iterations": 1})
    iteration = next(module.estimator.iterate(_clouds()))
    return module, iteration.hypotheses.select(iteration.winner)


def test_slots_have_a_say_in_which_hypothesis_is_chosen():
    module, _ = _selected(ObjectiveOptions())
    iteration = next(module.estimator.iterate(_clouds()))
    logits = iteration.hypotheses.association_logits
    upper = iteration.points[:, : logits.shape[1], 2] > 0  # the first part is said to be above
    said = torch.stack([upper, ~upper], dim=-1) * 20.0
    told = replace(iteration, hypotheses=replace(iteration.hypotheses, association_logits=said), agreement=10.0)
    height = [
        hypotheses.posed()[:, 0].mean(dim=2)[..., 2].diff(dim=-1).mean()  # of the second part over the first
        for hypotheses in (told.hypotheses.select(told.winner), iteration.hypotheses.select(iteration.winner))
    ]
    assert height[0] < -0.05 and height[0] < height[1]


@pytest.mark.parametrize(("detached", "moves"), [(True, False), (False, True)])
def test_joint_lines_pull_shapes_only_if_asked(detached, moves):
    """The difference that L_reg makes to the gradient of the shapes."""
    gradients = []
    for weight in (0.0, 1.0):
        objective = ObjectiveOptions(joint_regularization=weight, detached_shapes=detached)
        module, selected = _selected(objective)
        paper_terms(selected, _clouds(), objective).loss.backward()
        gradients.append(module.articulated.category)
    same = torch.equal(gradients[0].template.grad, gradients[1].template.grad)
    assert same is not moves
    assert not torch.equal(gradients[0].pivot.grad, gradients[1].pivot.grad)


def test_slots_are_taught_by_posed_parts_or_weight_them():
    taught, weighting = (ObjectiveOptions(association=name) for name in ("posterior", "slots"))
    _, selected = _selected(taught)
    by_parts, by_slots = (paper_terms(selected, _clouds(), objective) for objective in (taught, weighting))
    assert by_parts.segmentation > 0 and not by_parts.association.requires_grad
    assert by_slots.segmentation == 0 and by_slots.association.requires_grad
    with pytest.raises(ValueError, match="association must be"):
        ObjectiveOptions(association="guess")


def test_all_starts_are_the_networks_own_by_default():
    assert NetworkOptions().state_anchors is None


@pytest.mark.parametrize(("recipe", "asked", "counted"), [("paper", None, 6), ("paper", 2, 2), ("staged", None, 1)])
def test_several_points_of_a_part_say_how_near_it_is(recipe, asked, counted):
    module = tiny_module(recipe=recipe, inference=InferenceOptions(part_neighbours=asked)).eval()
    prediction = module.predict_points(clouds := _clouds(2), refine=False)
    posed = transform_points(prediction.part_pose, prediction.part_shape)
    distance = torch.cdist(clouds[:, None], posed).topk(counted, largest=False).values.mean(dim=-1)
    assert (prediction.part_id == distance.argmin(dim=1)).float().mean() > 0.99
