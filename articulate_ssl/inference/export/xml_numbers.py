"""Numbers as attributes of the XML formats."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def numbers(values: Iterable[float] | np.ndarray) -> str:
    """The values with nine significant digits, which hold a float32 exactly, with spaces between."""
    return " ".join(f"{value + 0.0:.9g}" for value in values)  # + 0.0 turns -0 into 0
