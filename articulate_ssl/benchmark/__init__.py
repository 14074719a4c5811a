"""`make bench`: speed and memory of the operators, of the backbones and of the whole network."""

from articulate_ssl.ops.idle_threads import sleep_soon

sleep_soon()  # as the command line does; before any module of this package imports PyTorch
