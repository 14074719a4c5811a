import torch

from articulate_ssl.inference.state_range import StateRange


def test_a_search_starts_in_the_middle_and_on_either_side_of_every_joint():
    states = StateRange(2)
    states.limits.copy_(torch.tensor([[0.0, 3.0], [-1.0, 2.0]]))
    expected = torch.tensor([[1.5, 0.5], [0.5, -0.5], [0.5, 1.5], [2.5, -0.5], [2.5, 1.5]])
    torch.testing.assert_close(states.starts(), expected)
    assert StateRange(1).starts().shape == (3, 1)


def test_the_range_is_a_running_mean_of_the_batches_that_were_seen():
    states = StateRange(1)
    states.follow(torch.tensor([[1.0], [2.0]]))
    torch.testing.assert_close(states.limits, torch.tensor([[1.0, 2.0]]))
    states.follow(torch.tensor([[0.0], [3.0]]))
    torch.testing.assert_close(states.limits, torch.tensor([[0.98, 2.02]]))


def test_what_is_seen_in_the_end_are_states_without_the_few_that_are_wrong():
    states = StateRange(2)
    assert not states.learnt and states.contains(torch.tensor([[9.0, 9.0]])).all()
    assert torch.equal(states.known, states.limits)
    spread = torch.linspace(0.0, 1.0, 401)
    seen = torch.stack([spread, 2 - spread], dim=1)
    seen[:8], seen[-8:] = -5.0, 7.0  # four of a hundred
    states.learn(seen)
    torch.testing.assert_close(states.known, torch.tensor([[0.0, 1.0], [1.0, 2.0]]), atol=0.01, rtol=0)
    inside = torch.tensor([[0.0, 2.0], [1.0, 1.0], [1.03, 1.5], [1.1, 1.5], [0.5, 0.9]])
    assert states.contains(inside).tolist() == [True, True, True, False, False]
    states.forget()
    assert not states.learnt


def test_weights_from_before_they_were_learnt_know_no_limits():
    states = StateRange(1)
    states.learn(torch.linspace(0, 1, 50)[:, None])
    older = {"limits": torch.tensor([[1.0, 2.0]])}
    states.load_state_dict(older)
    assert not states.learnt and torch.equal(states.known, older["limits"])
