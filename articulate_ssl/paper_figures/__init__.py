"""`make figures`: figures of the paper that show what a network has learnt, by any weights, on any labelled set."""

from articulate_ssl.ops.idle_threads import sleep_soon

sleep_soon()  # as the command line does; before any module of this package imports PyTorch
