"""Which part every point of every cloud belongs to, when part poses are known: what stays on the surface as it moves.

A point moved with its own part lies on the surface of every other cloud; moved with another part it does not, but for
faces that slide along themselves, which only their ends give away. Labels therefore spread along faces: a random walk
between neighbours on one plane, absorbed by what points say about themselves (Grady 2006, with priors).

A face that slides along itself is on the surface with any part, and chance decides, in each cloud otherwise. But points
of two clouds that lie on each other, moved with a part, are of that part in both or in none: so a point asks those that
it lies on in all other clouds, part by part, what they are (`agreed`).
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy.sparse import coo_matrix, diags, eye
from scipy.sparse.linalg import SuperLU, splu

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
# How often a point asks, how much answers count (as a power), and what is added to each. A CAD desk, whose drawers
# stand beside walls, gained .07 of IoU, and .08 by a power of 4, by which a chest lost .03: errors confirm each other.
_ASKED, _WEIGHT, _UNSAID = 3, 2, 0.02


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
    return _walk(surface, spread).solve(said)


def agreed(
    surfaces: list[Surface],  # n, of N points each
    pose: np.ndarray,  # [n, K, 4, 4] canonical object space -> clouds
    said: np.ndarray,  # [n, N, K] probability of every part, by what points say about themselves
) -> np.ndarray:  # [n, N, K]
    """The same for all points, by the faces that they are on and by those of other clouds that they lie on."""
    lain_on, walks = _lain_on(surfaces, pose), [_walk(surface, _SPREAD) for surface in surfaces]
    found = np.stack([walk.solve(own) for walk, own in zip(walks, said, strict=True)])
    for _ in range(_ASKED):
        # Of a point that lies on none, nothing is said: the last row.
        known = np.concatenate([found, np.zeros_like(found[:, :1])], axis=1)
        answers = _answers(known, lain_on)
        own = said * (answers + _UNSAID) ** _WEIGHT
        own /= own.sum(axis=-1, keepdims=True)
        found = np.stack([walk.solve(one) for walk, one in zip(walks, own, strict=True)])
    return found


def _answers(known: np.ndarray, lain_on: np.ndarray) -> np.ndarray:  # [n, N + 1, K] -> [n, N, K]
    """Mean over the other clouds of how likely the points that are lain on, moved with a part, are of that part."""
    clouds, parts = range(len(known)), range(known.shape[-1])
    total = [
        [sum(known[other, lain_on[own, other, part], part] for other in clouds if other != own) for part in parts]
        for own in clouds
    ]
    return np.moveaxis(np.array(total), 1, -1) / (len(known) - 1)


def _lain_on(surfaces: list[Surface], pose: np.ndarray) -> np.ndarray:  # [n, n, K, N]
    """Which point of every other cloud each point lies on, moved with every part; N where it lies on none."""
    n, parts, count = len(surfaces), pose.shape[1], len(surfaces[0].points)
    back, found = np.linalg.inv(pose), np.full((n, n, parts, count), count)
    for own, other in permutations(range(n), 2):
        for part in range(parts):
            moved = surfaces[own].moved(pose[other, part] @ back[own, part])
            found[own, other, part] = surfaces[other].under(moved)
    return found


def _walk(surface: Surface, spread: float) -> SuperLU:
    """What tells, of what all points of a cloud say, what is heard at each."""
    count = len(surface.points)
    index = surface.tree.query(surface.points, k=min(_NEIGHBOURS + 1, count))[1][:, 1:]
    rows, columns = np.repeat(np.arange(count), index.shape[1]), index.ravel()
    step = surface.points[rows] - surface.points[columns]
    height = [np.abs((step * surface.normals[end]).sum(axis=1)) for end in (rows, columns)]
    cosine = np.abs((surface.normals[rows] * surface.normals[columns]).sum(axis=1))
    weight = np.exp(-((np.maximum(*height) / _STEP) ** 2)) * cosine**_PARALLEL + _LOOSE
    walk = coo_matrix((weight, (rows, columns)), shape=(count, count)).tocsr()
    walk = walk.maximum(walk.T)
    laplacian = diags(np.asarray(walk.sum(axis=1)).ravel()) - walk
    return splu((spread * laplacian + eye(count)).tocsc())
