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
