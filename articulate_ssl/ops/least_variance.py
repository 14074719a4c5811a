"""How far neighbourhoods deviate from planes: the least variance of each.

Second moments are summed over neighbours, not built from gathered and centred ones, those of a smaller neighbourhood on
the way to those of a larger one; of a symmetric 3 x 3 matrix the least eigenvalue has a closed form (Smith 1961). Where
two eigenvalues are alike it loses half of its digits; standard deviations still come out to a millionth of a cloud's
size. `ops.reference` has the readable twin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_ROW, _COLUMN = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]  # of the entries of a symmetric matrix


def least_variance(
    points: np.ndarray,  # [m, 3] float64
    neighbours: np.ndarray,  # [m, n] indices, the nearest first
    counts: Sequence[int],  # ascending, n at most
) -> np.ndarray:  # [m, len(counts)]
    """Least variance, over all directions, of as many leading neighbours of every point as each count says."""
    centred = points - points.mean(axis=0)
    terms = np.concatenate([centred, centred[:, _ROW] * centred[:, _COLUMN]], axis=1)
    total, taken, found = 0.0, 0, []
    for count in counts:
        total = total + terms[neighbours[:, taken:count]].sum(axis=1)
        taken = count
        mean, square = total[:, :3] / count, total[:, 3:] / count
        found.append(_least_eigenvalue(square - mean[:, _ROW] * mean[:, _COLUMN]))
    return np.maximum(np.stack(found, axis=1), 0)


def _least_eigenvalue(
    entries: np.ndarray,  # [m, 6] of symmetric matrices, the upper triangle row by row
) -> np.ndarray:  # [m]
    xx, xy, xz, yy, yz, zz = entries.T
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a**2 + b**2 + c**2 + 2 * (xy**2 + xz**2 + yz**2)) / 6)
    determinant = a * (b * c - yz**2) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = np.clip(determinant / np.maximum(2 * spread**3, np.finfo(spread.dtype).tiny), -1, 1)
    return mean + 2 * spread * np.cos((np.arccos(cosine) + 2 * np.pi) / 3)
