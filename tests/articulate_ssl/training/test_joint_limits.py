"""Joint limits are what predictions of training clouds say, in the joint's own count."""

import pytest
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import joint_limits
from articulate_ssl.training.joint_limits import learn_joint_limits


@pytest.fixture
def clouds() -> torch.Tensor:
    return torch.rand(40, 2 * POINTS, 3, generator=torch.Generator().manual_seed(0))


def _module(**options):
    module = tiny_module(inference=InferenceOptions(refine=True, points=POINTS), **options).eval()
    module.num_points = POINTS
    return module


def test_they_are_of_predictions_whatever_these_count_from(clouds, monkeypatch):
    module = _module(state_range=2.0)
    spread = iter(torch.linspace(-1, 1, 40).split(16))
    predict = module.estimator.predict

    def told(points, *_, dense):
        assert torch.equal(points, dense[:, :POINTS])
        prediction = predict(points[:1], POINTS)
        state = next(spread)[:, None]
        return type(prediction)(**(vars(prediction) | {"joint_state": state}))

    monkeypatch.setattr(module.estimator, "predict", told)
    module.hinge_sides.learnt.fill_(True)
    module.hinge_sides.closed.fill_(0.5)
    learn_joint_limits(module, clouds)
    torch.testing.assert_close(module.states.seen, torch.tensor([[-0.5, 1.5]]), atol=0.02, rtol=0)
    torch.testing.assert_close(module.state_range, torch.tensor([[-1.0, 1.0]]), atol=0.02, rtol=0)


@pytest.mark.parametrize("options", [{"joint_type": "prismatic"}, {"refine": False}, {"few": True}])
def test_what_slides_is_not_registered_or_hardly_seen_has_none(clouds, monkeypatch, options):
    few, refine = options.pop("few", False), options.pop("refine", True)
    module = _module(**options)
    module.states.seen.copy_(torch.tensor([[0.0, 1.0]]))  # of a run that ended and goes on
    module.inference = InferenceOptions(refine=refine, points=POINTS)
    monkeypatch.setattr(module.estimator, "predict", lambda *_, **__: pytest.fail("predicted in vain"))
    learn_joint_limits(module, clouds[: joint_limits.FEWEST - 1] if few else clouds)
    assert not module.states.learnt
