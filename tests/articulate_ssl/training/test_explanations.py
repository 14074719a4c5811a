"""From a module's own predictions to a decision between two explanations, and what the decision then changes."""

import pytest
import roma
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.inference.candidates import ANOTHER_WAY
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.relief import NUM_FEATURES
from articulate_ssl.training import explanations
from articulate_ssl.training.explanations import _object_poses, learn_two_ways


@pytest.fixture
def module():
    # Explanations as registration leaves them: what is compared here comes before proportions.
    return tiny_module(inference=InferenceOptions(proportions=0)).eval()


@pytest.fixture
def clouds() -> torch.Tensor:
    """[6, 512, 3] of two boxes."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(6, 512, 3, generator=generator) * torch.tensor([0.6, 0.5, 0.2])
    points[:, ::2, 2] += 0.3
    return points - points.mean(dim=1, keepdim=True)


def taught(module, weight: float) -> None:
    """Each part where the other was; in favour of the explanation in which part 0 is longer, or, negative, shorter."""
    module.two_ways.slot.copy_(torch.tensor([1, 0]))
    module.two_ways.weight[2] = weight  # of the difference between the logarithms of part 0's lengths
    module.two_ways.learnt.fill_(True)


def test_few_clouds_teach_nothing_and_cost_nothing(module, clouds, monkeypatch):
    monkeypatch.setattr(module.estimator, "predict_with_rivals", lambda *_: pytest.fail("predicted in vain"))
    learn_two_ways(module, clouds)
    assert not module.two_ways.learnt


def test_an_object_with_one_explanation_gets_no_twin(module, clouds, monkeypatch):
    monkeypatch.setattr(explanations, "FEWEST", 1)
    learn_two_ways(module, clouds)  # too few for a relation: `two_ways` holds its own line
    assert not module.two_ways.learnt


@pytest.fixture
def untwinned(module, clouds, monkeypatch):
    """What was handed to `learn_surface` where fits tell explanations apart, the relation read off three clouds."""
    handed = []
    monkeypatch.setattr(explanations, "FEWEST", 1)
    monkeypatch.setattr(explanations, "_RELATED", 3)
    monkeypatch.setattr(module.two_ways, "learn_twin", lambda *_: False)
    monkeypatch.setattr(explanations, "learn_surface", lambda *lesson: handed.append(lesson))
    learn_two_ways(module, clouds)
    (lesson,) = handed
    return lesson


def test_where_fits_decide_they_teach(module, clouds, untwinned):
    versions, frames, order, least = untwinned
    chosen, rival = module.estimator.predict_with_rivals(clouds, module.num_points)
    for found, expected in zip(frames.unbind(1), (chosen, rival), strict=True):
        torch.testing.assert_close(found, expected.base_pose[:, :3, :3], atol=1e-4, rtol=0)
    assert torch.equal(versions[0], clouds) and not torch.equal(versions[1], clouds)
    assert least > 0.5 and len(set(order.tolist())) == len(order)
    turned = (chosen.base_pose - rival.base_pose).abs().amax(dim=(1, 2)) > 0
    assert sorted(order.tolist()) == turned.nonzero()[:, 0].tolist()
    assert not module.two_ways.learnt


class Preference(torch.nn.Module):
    """In the place of a network: of two explanations the one of which the object's x axis points up more, or less."""

    def __init__(self, sign: float) -> None:
        super().__init__()
        self.sign, self.temperature = sign, 1.0

    def log_odds(self, frames, dense):
        return self.sign * (frames[:, 0, 2, 0] - frames[:, 1, 2, 0])


def test_a_network_that_fits_taught_decides_between_predictions_and_rivals(module, clouds):
    fits = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, False, clouds)
    found = {}
    for sign in (1.0, -1.0):
        module.two_ways.surface = Preference(sign)
        found[sign] = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, False, clouds)
    same = torch.testing.assert_close
    rivalled = found[1.0][0].margin > 0
    assert rivalled.any()
    same(found[1.0][0].base_pose[rivalled], found[-1.0][1].base_pose[rivalled])
    up = [one.base_pose[rivalled, 2, 0] for one in found[1.0]]
    assert (up[0] > up[1]).all()
    blind = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, False)
    same(blind[0].base_pose, fits[0].base_pose, atol=0, rtol=0)


def test_a_preferred_rival_is_registered_again_from_other_states(module, clouds, monkeypatch):
    """Rivals with joints far from where they fit come back to a fit, turned as they were; what is kept stays."""
    points = clouds[:, :POINTS]
    one, rival, margin = module.estimator._best(module.estimator._candidates(points, POINTS, registers=True))
    stuck = rival.at(rival.base, rival.state + 1.5)
    monkeypatch.setattr(module.estimator, "_best", lambda _: (one, stuck, margin))
    other = rival.base[:, 0, 2, 0] - one.base[:, 0, 2, 0]
    module.states.limits.copy_(torch.tensor([[-1.0, 1.0]]))
    for sign in (1.0, -1.0):
        module.two_ways.surface = Preference(sign)
        found, _ = module.estimator.predict_with_rivals(points, POINTS, True, clouds)
        preferred = sign * other > 0
        before, kept = (module.estimator._packaged(some, points, margin) for some in (stuck, one))
        assert preferred.any()
        assert (found.reconstruction_error < before.reconstruction_error)[preferred].all()
        angle = roma.rotmat_geodesic_distance(found.base_pose[:, :3, :3], before.base_pose[:, :3, :3])
        assert (angle[preferred] < ANOTHER_WAY + 1e-4).all()
        torch.testing.assert_close(found.base_pose[~preferred], kept.base_pose[~preferred])


def test_what_has_no_rival_keeps_its_margin(module, clouds, monkeypatch):
    one, _, margin = module.estimator._best(module.estimator._candidates(clouds[:, :POINTS], POINTS, registers=False))
    monkeypatch.setattr(module.estimator, "_best", lambda _: (one, one, torch.full_like(margin, 0.7)))
    module.two_ways.surface = Preference(1.0)
    found, _ = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, False, clouds)
    assert (found.margin == 0.7).all()


def test_what_was_taught_has_a_say_in_the_search_without_the_network(module, clouds):
    module.states.limits.copy_(torch.tensor([[-1.0, 1.0]]))
    taught(module, 50.0)
    found = []
    for preference in (1e3, -1e3):
        module.two_ways.surface = Preference(preference)
        found.append(module.estimator.search(clouds[:, :POINTS], clouds).base_pose)
    assert ((found[0] - found[1]).abs().amax(dim=(1, 2)) > 1e-3).all()


def test_what_relief_says_teaches_exchanged_parts_too(module, clouds, monkeypatch):
    """Views are of the explanations, in both versions; which are held to be right is what relief says of them."""
    handed = []
    monkeypatch.setattr(explanations, "FEWEST", 1)
    taught(module, 50.0)
    for step in ("learn_twin", "learn_decision"):
        monkeypatch.setattr(module.two_ways, step, lambda *_: True)
    monkeypatch.setattr(explanations, "learn_from_near", lambda *lesson: handed.append(lesson))
    learn_two_ways(module, clouds)
    ((views, right, whole, _, least),) = handed
    assert views.points.shape[:3] == (2, 6, 2) and not torch.equal(views.points[0], views.points[1])
    count = explanations.registered_points(module)
    found = module.estimator.both_ways(clouds[:, :count], module.num_points, (clouds,))
    torch.testing.assert_close(views.frames, found.views.frames, atol=1e-4, rtol=0)
    assert torch.equal(right, module.two_ways.relief_odds(*found.reliefs[0]) > 0)
    assert (whole == 0).all() and least > 0.5  # too few for a network that sees whole clouds
    assert module.two_ways.surface is None and module.two_ways.near is None


def test_the_decision_is_taught_with_noise_of_every_strength(module, clouds, monkeypatch):
    seen = []

    def relief(one, dense):
        seen.append(dense)
        return torch.zeros(len(dense), 2 * NUM_FEATURES)

    monkeypatch.setattr(explanations, "FEWEST", 1)
    monkeypatch.setattr(module.two_ways, "learn_twin", lambda *_: True)
    monkeypatch.setattr(module.estimator.decision, "relief", relief)
    learn_two_ways(module, clouds)
    clean, twin, noisy, noisy_twin = seen
    assert clean is twin and torch.equal(clean, clouds) and noisy is noisy_twin
    strength = (noisy - clouds).flatten(1).std(dim=1)
    assert strength.max() < 0.0105 and strength.max() > 2 * strength.min()


@pytest.mark.parametrize("refine", [True, False])
def test_without_dense_points_nothing_is_decided(module, clouds, refine):
    before = module.predict_points(clouds[:, :POINTS], refine)
    taught(module, 100.0)
    after = module.predict_points(clouds[:, :POINTS], refine)
    torch.testing.assert_close(after.base_pose, before.base_pose, atol=0, rtol=0)
    torch.testing.assert_close(after.margin, before.margin, atol=0, rtol=0)


@pytest.mark.parametrize("refine", [True, False])
def test_the_decision_chooses_one_of_the_same_two_explanations(module, clouds, refine):
    """Opposite preferences give opposite answers, the better explanation of one is the rival of the other."""
    taught(module, 50.0)
    longer = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, refine, clouds)
    taught(module, -50.0)
    shorter = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, refine, clouds)
    decided = longer[0].margin > 0
    assert decided.any()
    torch.testing.assert_close(longer[0].base_pose[decided], shorter[1].base_pose[decided])
    torch.testing.assert_close(longer[1].base_pose[decided], shorter[0].base_pose[decided])
    torch.testing.assert_close(longer[0].margin, shorter[0].margin)


def test_unregistered_predictions_have_a_twin_that_follows_from_them(module, clouds):
    """Nothing moves the other explanation but the relation that was learnt."""
    taught(module, 50.0)
    found, other = module.estimator.predict_with_rivals(clouds[:, :POINTS], POINTS, False, clouds)
    root, related = module.articulated.category.chain().root, []
    for one, two in ((found, other), (other, found)):
        expected = module.two_ways.twin_poses(_object_poses(one))[:, root]
        related.append((_object_poses(two)[:, root] - expected).abs().amax(dim=(1, 2)) < 1e-4)
    assert (related[0] | related[1]).all()


def test_a_search_without_the_network_is_decided_alike(module, clouds):
    module.states.limits.copy_(torch.tensor([[-1.0, 1.0]]))
    taught(module, 50.0)
    longer = module.estimator.search(clouds[:, :POINTS], clouds)
    taught(module, -50.0)
    shorter = module.estimator.search(clouds[:, :POINTS], clouds)
    torch.testing.assert_close(longer.margin, shorter.margin)
    turned = (longer.base_pose - shorter.base_pose).abs().amax(dim=(1, 2)) > 1e-3
    assert turned[longer.margin > 0].all() and (longer.margin > 0).any()


def test_the_decision_is_part_of_the_weights(module):
    taught(module, 3.0)
    other = tiny_module()
    other.load_state_dict(module.state_dict())
    assert other.estimator.two_ways.learnt and other.estimator.two_ways.slot.tolist() == [1, 0]
    assert len(other.two_ways.weight) == 2 * NUM_FEATURES


def test_scans_are_decided_on_all_their_points(module, clouds):
    taught(module, 50.0)
    module.radius.follow(clouds[:, :POINTS], 0)
    seen = []
    decide = module.two_ways.relief_odds
    module.two_ways.relief_odds = lambda one, other: seen.append(one) or decide(one, other)
    scans = [cloud.double().numpy() * 7 + 1 for cloud in clouds[:2]]
    estimates = module.predict_clouds(scans)
    assert len(estimates) == len(seen) == 2
    for estimate in estimates:
        assert 0 <= float(estimate.prediction.margin) <= 1
