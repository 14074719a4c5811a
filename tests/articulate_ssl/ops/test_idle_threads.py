"""Threads that wait for each other sleep soon, unless the user's environment says otherwise."""

import os
import subprocess
import sys

import pytest

_PROGRAM = """if True:
    import sys
    from articulate_ssl.cli import main
    assert "torch" not in sys.modules
    try:
        main(["predict", "--help"])
    finally:
        import torch
"""


@pytest.mark.skipif(sys.platform != "linux", reason="PyTorch brings libgomp on Linux only")
@pytest.mark.parametrize(
    ("said", "spins"),
    [({}, "1000"), ({"GOMP_SPINCOUNT": "77"}, "77"), ({"OMP_WAIT_POLICY": "passive"}, "0")],
)
def test_openmp_of_the_command_line_spins_for_as_long_as_it_should(said, spins):
    told = {k: v for k, v in os.environ.items() if k not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env={**told, **said, "OMP_DISPLAY_ENV": "verbose"},
        capture_output=True,
        text=True,
    )
    assert f"GOMP_SPINCOUNT = '{spins}'" in done.stderr
