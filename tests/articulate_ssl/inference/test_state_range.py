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


def test_limits_are_where_most_states_are_in_a_range_as_wide_as_the_category_says():
    states = StateRange(2)
    assert not states.learnt and states.contains(torch.tensor([[9.0, 9.0]])).all()
    assert torch.equal(states.known, states.limits)
    spread = torch.linspace(0.0, 1.0, 401)
    seen = torch.stack([spread, 2 - spread], dim=1)
    # Three in ten are explained by another door, whose states go on where the right ones end, and some are lost.
    seen[::3, 0] = 2 - seen[::3, 0]
    seen[:8] = -5.0
    states.learn(seen, 1.0)
    torch.testing.assert_close(states.known, torch.tensor([[0.0, 1.0], [1.0, 2.0]]), atol=0.03, rtol=0)
    inside = torch.tensor([[0.03, 1.97], [1.0, 1.03], [1.02, 1.5], [1.1, 1.5], [0.5, 0.9]])
    assert states.contains(inside).tolist() == [True, True, True, False, False]
    assert states.contains(inside[None], slack=0.2).all()
    states.forget()
    assert not states.learnt


def test_a_closed_door_is_possible_though_none_was_seen():
    states = StateRange(1)
    states.learn(torch.linspace(1, 2, 50)[:, None], 1.0)
    state = torch.tensor([[0.1], [0.5], [1.5], [2.5]])
    assert states.contains(state).tolist() == states.showed(state).tolist() == [False, False, True, False]
    states.set_rest(0.1)
    assert states.contains(state).tolist() == [True, True, True, False]
    assert states.showed(state).tolist() == [False, False, True, False]
    states.set_rest(2.5)  # at the other end
    assert states.contains(state).tolist() == [False, False, True, True]
    again = StateRange(1)
    again.load_state_dict(states.state_dict())
    assert torch.equal(again.possible, states.possible)
    states.forget()
    assert not states.rests


def test_weights_from_before_they_were_learnt_know_no_limits():
    states = StateRange(1)
    states.learn(torch.linspace(0, 1, 50)[:, None], 1.0)
    older = {"limits": torch.tensor([[1.0, 2.0]])}
    states.load_state_dict(older)
    assert not states.learnt and torch.equal(states.known, older["limits"])
    assert not states.rests and torch.equal(states.possible, states.known)
