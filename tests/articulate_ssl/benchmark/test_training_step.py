"""The training step that is timed is one."""

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.training_step import training_step
from articulate_ssl.network.options import NetworkOptions


def test_training_step_changes_the_network():
    machine = Machine("cpu", "32")
    options = NetworkOptions(
        group_order=12,
        dims=[4, 6],
        radii=[0.2, 0.3],
        num_neighbors=8,
        num_kernel_points=13,
        head_dim=8,
        shape_points=16,
    )
    step = training_step(machine, options, batch=2, num_points=32)
    step()
    assert machine.seconds(step) > 0
