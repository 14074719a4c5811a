"""Colours as glTF and USD state them."""

from __future__ import annotations

import numpy as np


def linear_colour(
    colour: np.ndarray,  # [..., 3] sRGB, as screens show it, 0 to 1
) -> np.ndarray:  # [..., 3]
    """The same colour in linear light (IEC 61966-2-1)."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
