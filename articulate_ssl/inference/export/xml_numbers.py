"""Numbers as attributes of the XML formats."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def numbers(values: Iterable[float] | np.ndarray, digits: int = 9) -> str:
    """The values with spaces between.

    Args:
        digits: Significant ones; nine hold a float32 exactly, fifteen are what a float64 holds of any decimal number.
    """
    return " ".join(f"{value + 0.0:.{digits}g}" for value in values)  # + 0.0 turns -0 into 0
