"""The training step that is timed is one."""

import pytest

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.training_step import build_module, training_step
from articulate_ssl.network.options import NetworkOptions

OPTIONS = NetworkOptions(
    group_order=12,
    dims=[4, 6],
    radii=[0.2, 0.3],
    num_neighbors=8,
    num_kernel_points=13,
    head_dim=8,
    shape_points=16,
)


def test_training_step_changes_the_network():
    machine = Machine("cpu", "32")
    step = training_step(machine, OPTIONS, batch=2, num_points=32)
    step()
    assert machine.seconds(step) > 0


@pytest.mark.parametrize(("precision", "mixed"), [("32", False), ("bf16", True)])
def test_the_network_runs_in_the_precision_that_is_measured(precision, mixed):
    assert build_module(Machine("cpu", precision), OPTIONS).articulated.mixed_precision is mixed
