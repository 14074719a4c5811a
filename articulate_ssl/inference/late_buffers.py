"""What a module learnt to know later than weights were written: they load, and know nothing of it."""

from __future__ import annotations

from torch import nn


class LateBuffers(nn.Module):
    """A module whose own buffers weights may lack; those stay as they are when such weights are loaded."""

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        for name, value in self.named_buffers(recurse=False):
            state_dict.setdefault(prefix + name, value.clone())
        super()._load_from_state_dict(state_dict, prefix, *rest)
