"""Random generators whose stream depends only on what is drawn, never on who draws it or when."""

from __future__ import annotations

import hashlib

import numpy as np


def generator_for(seed: int, *key: str | int) -> np.random.Generator:
    """Independent generator for a key such as ("train", instance id, "view", state, view)."""
    digest = hashlib.sha256(repr(key).encode()).digest()
    return np.random.default_rng(np.random.SeedSequence([seed, int.from_bytes(digest[:16], "little")]))
