"""Where predictions are computed: a device is tried before anything is loaded for it."""

from __future__ import annotations

import torch


class DeviceError(ValueError):
    """A device is not there, or cannot compute what predictions need; the message names it and says what there is."""


def usable_device(device: str | torch.device) -> torch.device:
    """The device of a name ("cpu", "cuda", "cuda:1"), after a number was computed on it.

    Raises:
        DeviceError: if PyTorch cannot compute on it here.
    """
    try:
        found = torch.device(device)
        torch.ones(1, dtype=torch.float64, device=found).sum().item()  # float64, as in some decisions
    except Exception as error:  # each backend fails in its own way where its library, driver or hardware is missing
        count = torch.cuda.device_count()
        there = f"cpu or cuda:0 … cuda:{count - 1}" if count else "cpu, as there is no CUDA device here"
        raise DeviceError(f"{str(device)!r} is no device that PyTorch can compute on here; use {there}") from error
    return found
