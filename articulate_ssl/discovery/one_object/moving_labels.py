"""Which part every point of every cloud belongs to, when part poses are known: what stays on the surface as it moves.

A point moved with its own part lies on the surface of every other cloud; moved with another part it does not, but for
faces that slide along themselves, which only their ends give away. Labels therefore spread along faces: a random walk
between neighbours on one plane, absorbed by what points say about themselves (Grady 2006, with priors).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, diags, eye
from scipy.sparse.linalg import splu

from articulate_ssl.discovery.one_object.surface import Surface

CAP = 0.02  # normalised units: a point farther than this from the surface is not on it
_NEIGHBOURS = 12  # of a point, between which the walk goes
# Normalised units. A step along a normal of this length ends the walk. From .003 to .006 chests of known poses gained
# .02 of IoU, and laptops lost .015.
_STEP = 0.004
_PARALLEL = 16  # power of the cosine between normals that a step is weighted by
_LOOSE = 1e-4  # weight of a step between faces, which keeps lone points solvable
_EVIDENCE = 0.001  # normalised units: how much farther a part must be to be e times as unlikely
_SURPRISE = 0.02  # share of votes that a part has which none is for. Chosen.
# How far labels spread that motion says: on chests of known poses, IoU .65 without, .73 at 10, .79 at 100, .83 at 300,
# .74 at 1000.
_SPREAD = 200.0


def moving_costs(
    surfaces: list[Surface],  # n
    pose: np.ndarray,  # [n, K, 4, 4] canonical object space -> clouds
    count: int,
) -> np.ndarray:  # [n, count, K]
    """How far the first points of each cloud are from the other clouds on average, moved with each part."""
    back = np.linalg.inv(pose)
    cost = np.zeros((len(surfaces), count, pose.shape[1]))
    for i, own in enumerate(surfaces):
        own = own.thinned(count)
        for part in range(pose.shape[1]):
            for j, other in enumerate(surfaces):
                if j != i:
                    cost[i, :, part] += other.nearest(own.moved(pose[j, part] @ back[i, part]), CAP)
    return cost / (len(surfaces) - 1)


def believed(
    cost: np.ndarray,  # [..., K] of `moving_costs`
    votes: np.ndarray | None = None,  # [..., K] shares of what else says which part points are of
) -> np.ndarray:  # [..., K]
    """Probability of every part for every point, by what it says about itself."""
    said = np.exp(-(cost - cost.min(axis=-1, keepdims=True)) / _EVIDENCE)
    if votes is not None:
        said = said * (votes + _SURPRISE)
    return said / said.sum(axis=-1, keepdims=True)


def spread_labels(
    surface: Surface,
    said: np.ndarray,  # [N, K] probability of every part, by what points say about themselves
    spread: float = _SPREAD,
) -> np.ndarray:  # [N, K]
    """The same for every point of one cloud, by what the face says that it is on.

    Args:
        spread: How far labels spread.
    """
    count = len(said)
    index = surface.tree.query(surface.points, k=min(_NEIGHBOURS + 1, count))[1][:, 1:]
    rows, columns = np.repeat(np.arange(count), index.shape[1]), index.ravel()
    step = surface.points[rows] - surface.points[columns]
    height = [np.abs((step * surface.normals[end]).sum(axis=1)) for end in (rows, columns)]
    cosine = np.abs((surface.normals[rows] * surface.normals[columns]).sum(axis=1))
    weight = np.exp(-((np.maximum(*height) / _STEP) ** 2)) * cosine**_PARALLEL + _LOOSE
    walk = coo_matrix((weight, (rows, columns)), shape=(count, count)).tocsr()
    walk = walk.maximum(walk.T)
    laplacian = diags(np.asarray(walk.sum(axis=1)).ravel()) - walk
    return splu((spread * laplacian + eye(count)).tocsc()).solve(said)
