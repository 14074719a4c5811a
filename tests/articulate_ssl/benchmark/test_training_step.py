"""The training step that is timed is one."""

import pytest

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.paper_size import TRIAL_NETWORK
from articulate_ssl.benchmark.training_step import build_module, training_step


def test_training_step_changes_the_network():
    machine = Machine("cpu", "32")
    step = training_step(machine, TRIAL_NETWORK, batch=2, num_points=32)
    step()
    assert machine.seconds(step) > 0


@pytest.mark.parametrize(("precision", "mixed"), [("32", False), ("bf16", True)])
def test_the_network_runs_in_the_precision_that_is_measured(precision, mixed):
    assert build_module(Machine("cpu", precision), TRIAL_NETWORK).articulated.mixed_precision is mixed
