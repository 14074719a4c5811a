"""One colour per part, the same in every file and picture."""

from __future__ import annotations

import numpy as np

# Okabe and Ito's colours, which people with any colour vision tell apart.
PALETTE = np.array(
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0), (86, 180, 233), (240, 228, 66)],
    dtype=np.uint8,
)


def part_colour(
    part: np.ndarray | int,  # [...] part indices
) -> np.ndarray:  # [..., 3] uint8
    """RGB of a part; more parts than colours start again."""
    return PALETTE[np.asarray(part) % len(PALETTE)]
