"""Confidence: a regression on how clearly and how well predictions fit, and percentiles of how well."""

import pytest
import torch

from articulate_ssl.inference.confidence import Confidence


def _clouds(count: int = 400) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Errors, margins and agreement of clouds that agree the more often, the larger the margin and the smaller the
    error."""
    generator = torch.Generator().manual_seed(0)
    error = 0.02 * (0.3 * torch.randn(count, generator=generator)).exp()
    margin = torch.rand(count, generator=generator)
    score = 6 * (margin - 0.4) - 2 * (error / 0.02).log()
    return error, margin, torch.rand(count, generator=generator) < score.sigmoid()


def _learnt() -> Confidence:
    confidence = Confidence()
    confidence.learn(*_clouds())
    return confidence


def test_probabilities_are_those_of_agreement():
    error, margin, agrees = _clouds()
    probability = _learnt().probability(margin, error)
    for low in (0.0, 0.25, 0.5, 0.75):
        some = (probability >= low) & (probability < low + 0.25)
        assert float(probability[some].mean()) == pytest.approx(float(agrees[some].float().mean()), abs=0.12)


def test_a_clear_margin_is_more_probable_and_a_bad_fit_less():
    confidence, error, margin = _learnt(), torch.tensor([0.02, 0.02, 0.04]), torch.tensor([0.2, 0.8, 0.2])
    low, clear, bad = confidence.probability(margin, error)
    assert bad < low < clear


def test_margins_of_hundredths_say_as_much_as_margins_of_tenths():
    error, margin, agrees = _clouds()
    confidence = Confidence()
    confidence.learn(error, margin / 100, agrees)
    torch.testing.assert_close(confidence.probability(margin / 100, error), _learnt().probability(margin, error))


def test_where_all_agree_nothing_is_certain_and_a_margin_counts_for_little():
    error, margin, agrees = _clouds()
    confidence = Confidence()
    confidence.learn(error[:20], margin[:20], torch.ones_like(agrees[:20]))
    probability = confidence.probability(margin, error)
    assert probability.min() > 0.6 and probability.max() < 0.999


def test_unlike_is_the_share_of_training_clouds_with_smaller_errors():
    error = _clouds()[0]
    confidence = _learnt()
    assert confidence.unlike(error).mean() == pytest.approx(0.5, abs=0.02)
    assert confidence.unlike(10 * error.max()[None]) == 1 and confidence.unlike(torch.zeros(1)) == 0


def _unlike(slope: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Clouds that fit as those of training do, and worse, and agree the less often, the more they fit worse."""
    error, margin, _ = _clouds()
    generator = torch.Generator().manual_seed(1)
    error = error * (2 * torch.rand(len(error), generator=generator)).exp()
    learnt = _learnt()
    score = learnt.probability(margin, error).logit() + slope * learnt._excess(error)
    return error, margin, torch.rand(len(error), generator=generator) < score.sigmoid()


def test_what_no_training_cloud_was_like_is_as_doubtful_as_it_proves_to_be():
    error, margin, agrees = _unlike(-1.5)
    confidence = _learnt()
    before = confidence.probability(margin, error)
    confidence.learn_strangeness(error, margin, agrees)
    assert confidence.strangeness == pytest.approx(-1.5, abs=0.4)
    after, like = confidence.probability(margin, error), confidence.unlike(error) < 0.98
    assert torch.equal(after[like], before[like])
    strange = confidence._excess(error) > 1
    assert strange.sum() > 20 and after[strange].mean() < before[strange].mean() - 0.05


def test_what_proves_right_is_not_doubted_for_being_unlike():
    error, margin, agrees = _unlike(0.0)
    confidence = _learnt()
    before = confidence.probability(margin, error)
    confidence.learn_strangeness(error, margin, torch.ones_like(agrees))
    torch.testing.assert_close(confidence.probability(margin, error), before, atol=1e-3, rtol=0)


def test_learnt_anew_it_forgets_what_unlike_clouds_were_worth():
    confidence = _learnt()
    confidence.learn_strangeness(*_unlike(-1.5))
    confidence.learn(*_clouds())
    assert confidence.strangeness == 0


def test_weights_of_before_unlike_clouds_were_doubted_load():
    state = _learnt().state_dict()
    del state["strangeness"]
    fresh = Confidence()
    fresh.load_state_dict(state)
    error, margin, _ = _clouds()
    assert torch.equal(fresh.probability(margin, error), _learnt().probability(margin, error))


def test_it_is_kept_with_the_weights():
    learnt, fresh = _learnt(), Confidence()
    error, margin, agrees = _unlike(-1.5)
    learnt.learn_strangeness(error, margin, agrees)
    assert not fresh.learnt
    fresh.load_state_dict(learnt.state_dict())
    assert fresh.learnt and torch.equal(fresh.probability(margin, error), learnt.probability(margin, error))


@pytest.mark.parametrize("error", [[], [0.01, float("nan")]])
def test_nothing_is_learnt_from_nothing(error):
    looks = torch.tensor(error), torch.ones(len(error)), torch.ones(len(error), dtype=torch.bool)
    for learn in (Confidence().learn, _learnt().learn_strangeness):
        with pytest.raises(ValueError, match="one cloud or more"):
            learn(*looks)
