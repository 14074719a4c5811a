"""Slots keep their order, treat points as a set, and are deterministic."""

import torch

from articulate_ssl.network.slot_attention import SlotAttention


def _proposal():
    torch.manual_seed(0)
    return SlotAttention(5, num_slots=3, slot_dim=8).double(), torch.randn(2, 20, 5, dtype=torch.float64)


def test_points_are_a_set_and_samples_are_independent():
    attention, features = _proposal()
    logits = attention(features)
    assert logits.shape == (2, 20, 3)
    order = torch.randperm(20)
    torch.testing.assert_close(attention(features[:, order]), logits[:, order])
    torch.testing.assert_close(attention(features[:1]), logits[:1])
    assert torch.equal(attention(features), logits)


def test_slots_compete_and_differ():
    attention, features = _proposal()
    association = attention(features).softmax(dim=-1)
    assert association.std(dim=-1).min() > 0


def test_identical_points_and_a_single_point_are_free_of_nan():
    attention, features = _proposal()
    for some in (features[:, :1], features[:, :1].expand(-1, 9, -1)):
        logits = attention(some)
        logits.sum().backward()
        assert logits.isfinite().all()
    assert all(p.grad.isfinite().all() for p in attention.parameters())


def test_a_slot_that_no_point_chooses_is_free_of_nan():
    attention, features = _proposal()
    with torch.no_grad():
        attention.to_query.weight.mul_(1e5)  # competition becomes a hard choice
    logits = attention(features[:, :1].expand(-1, 9, -1))
    assert (logits.softmax(dim=-1).sum(dim=1) == 0).any()
    logits.softmax(dim=-1)[..., 0].sum().backward()
    assert logits.isfinite().all()
    assert all(p.grad.isfinite().all() for p in attention.parameters())


def test_every_parameter_gets_a_gradient():
    attention, features = _proposal()
    attention(features).square().sum().backward()
    assert {n for n, p in attention.named_parameters() if p.grad is None or p.grad.abs().max() == 0} == set()
