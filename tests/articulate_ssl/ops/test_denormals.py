"""Denormal numbers are flushed within, and only within, the block that asks for it."""

import pytest
import torch

from articulate_ssl.ops.denormals import flush_denormals


def _flushed() -> bool:
    return bool(torch.tensor(1e-40) * 1.0 == 0)


def test_importing_the_package_leaves_the_processor_alone():
    """Flushing for good breaks other code of the process; hypothesis, for one, refuses to run."""
    import articulate_ssl.discovery.registration  # noqa: F401

    assert not _flushed()


def test_the_mode_is_restored_also_behind_an_error_and_when_nested():
    with pytest.raises(RuntimeError), flush_denormals():
        with flush_denormals():
            assert _flushed()
        assert _flushed()
        raise RuntimeError
    assert not _flushed()
