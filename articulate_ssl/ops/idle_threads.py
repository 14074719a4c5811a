"""How long threads of PyTorch wait for each other before they sleep."""

import os

# Iterations, some microseconds; by default 300,000, which is milliseconds.
_SPIN_COUNT = "1000"


def sleep_soon() -> None:
    """Let threads that wait for each other sleep soon, in this process and in those that it starts.

    By default they spin for so long that on cores which other programs keep busy most of the time is spent on waiting:
    training with two threads on two cores, beside one other program, took 20 seconds a step instead of 1.1, for .5
    instead of about .6 where nothing else ran (docs/experiments.md, step 107). What the user's environment says of
    waiting stays. It is OpenMP's environment (libgomp), read once: call this before PyTorch is imported.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPIN_COUNT)
