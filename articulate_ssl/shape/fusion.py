"""One dense shape from many clouds: what clouds show, moved back to where the shape is, is seen again in most of them.

A category's shape is some cloud's, with what that cloud alone has, and some of its points are of the wrong part. Where
every cloud's pose, joint states and stretches are known (`PartMaps`), all clouds can be laid over each other, part by
part. Which part a point is of shows then: moved back with its own, it meets points of most other clouds; with another,
only those of clouds in like joint states. What few clouds show is left out, and a part that moves is in one piece.

About the line of a joint both parts move alike, and nothing shows which a point is of: there the shape stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.part_maps import PartMaps

FUSED_POINTS = 1024  # of each part
# All in normalised units, or shares of the clouds; chosen on development objects (docs/experiments.md, step 140).
_MEETS = 0.02  # points so near are of the same place
_SPREAD = 0.025  # surfaces of different objects lie so far apart
_SEEN = 0.35  # of the clouds show what stays
_CLEARER = 0.1  # by so many more clouds one part must explain a point better than another
_NEAR_LINE = 0.08  # both parts of a joint move alike; and points are so near at most to the part they are of
_LINK = 0.05  # a piece has no wider gaps
_WITNESSES, _SAMPLED = 40, 6000  # clouds that are asked, and points of each part: enough
_ROUNDS = 3  # of moving points to the middle of the surfaces about them
_FEWEST = 8  # points that tell how a surface lies


def fused(
    shape: ArticulatedShape,
    maps: PartMaps,  # of n clouds, from the shape to each
    clouds: Tensor,  # [n, N, 3]
) -> ArticulatedShape | None:
    """The shape that clouds have in common, with `FUSED_POINTS` points a part, some of them several times.

    Points are as far apart on every part: the nearest one tells parts apart where that is so.

    Returns:
        None if too little of a part is seen in enough clouds.
    """
    device, parts = clouds.device, range(shape.num_parts)
    back = [_moved_back(maps, part, clouds).cpu().numpy() for part in parts]
    posed = maps.move(shape.points, shape.label)
    distance = torch.stack([nearest_distance(clouds, posed[:, shape.label == part]) for part in parts], dim=-1)
    label = _labelled(distance.cpu().numpy(), back)
    lines = list(zip(shape.joints.axis.cpu().numpy(), shape.joints.pivot.cpu().numpy(), strict=True))
    root, seen = shape.joints.chain.root, []
    for part in parts:
        found = _seen_again(back[part], label == part)
        found = found if part == root else _largest_piece(found)
        old = shape.part(part).cpu().numpy()
        found = found[_to_lines(found, lines) >= _NEAR_LINE]
        if len(found) < _FEWEST:
            return None
        found = np.concatenate([old[_to_lines(old, lines) < _NEAR_LINE], found])
        seen.append(found[farthest_point_order(found, min(FUSED_POINTS, len(found)))])
    points = [np.resize(found, (FUSED_POINTS, 3)) for found in _equally_dense(seen)]
    label = torch.arange(shape.num_parts, device=device).repeat_interleave(FUSED_POINTS)
    return replace(shape, points=torch.as_tensor(np.concatenate(points)).to(clouds), label=label)


def _moved_back(maps: PartMaps, part: int, clouds: Tensor) -> Tensor:
    """Clouds [n, N, 3] as if all points were of one part, where that is in the shape."""
    offset = clouds - maps.shift[:, part, None]
    return torch.linalg.solve(maps.linear[:, part, None], offset[..., None]).squeeze(-1)


def _labelled(distance: np.ndarray, back: Sequence[np.ndarray]) -> np.ndarray:
    """Part of every point [n, N]: the nearest one, by distances [n, N, K], or one with which it meets more clouds."""
    witnesses = [[cKDTree(cloud) for cloud in moved[:_WITNESSES]] for moved in back]
    meets = np.stack(
        [
            np.stack([np.mean([_reached(tree, cloud) for tree in trees], axis=0) for cloud in moved])
            for trees, moved in zip(witnesses, back, strict=True)
        ],
        axis=-1,
    )
    two = np.sort(meets, axis=-1)[..., -2:]
    most = meets.argmax(axis=-1)
    near = np.take_along_axis(distance, most[..., None], axis=-1)[..., 0] < _NEAR_LINE
    return np.where(near & (two[..., 1] - two[..., 0] > _CLEARER), most, distance.argmin(axis=-1))


def _reached(tree: cKDTree, points: np.ndarray) -> np.ndarray:
    return tree.query(points, distance_upper_bound=_MEETS)[0] < _MEETS


def _seen_again(moved: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Of a part's points [n, N, 3] some of those that enough clouds show, in the middle of the surfaces about them."""
    points, cloud = moved[own], np.nonzero(own)[0]
    some = np.random.default_rng(0).permutation(len(points))[:_SAMPLED]
    if not len(some):
        return points
    tree = cKDTree(points)
    near = tree.query_ball_point(points[some], _SPREAD)
    share = np.array([len(np.unique(cloud[rows])) for rows in near]) / len(moved)
    found = points[some][share >= _SEEN]
    for _ in range(_ROUNDS if len(found) else 0):
        near = tree.query_ball_point(found, _SPREAD)
        found = np.stack([_centred(point, points[rows]) for point, rows in zip(found, near, strict=True)])
    return found


def _centred(point: np.ndarray, near: np.ndarray) -> np.ndarray:
    """A point moved along the normal of the surfaces about it to their middle."""
    if len(near) < _FEWEST:
        return point
    middle = near.mean(axis=0)
    normal = np.linalg.eigh(np.cov((near - middle).T))[1][:, 0]
    return point + normal * (normal @ (middle - point))


def _largest_piece(points: np.ndarray) -> np.ndarray:
    if not len(points):
        return points
    pairs = cKDTree(points).query_pairs(_LINK, output_type="ndarray")
    linked = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    piece = connected_components(linked, directed=False)[1]
    return points[piece == np.bincount(piece).argmax()]


def _to_lines(points: np.ndarray, lines: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Of points from the nearest joint line."""
    return np.min([np.linalg.norm(np.cross(points - pivot, axis), axis=-1) for axis, pivot in lines], axis=0)


def _equally_dense(parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """As many of each part's points, in farthest-point order, as are as far apart as those of the sparsest part."""
    gaps = [np.median(cKDTree(points).query(points, k=2)[0][:, 1]) for points in parts]
    return [
        points[: max(_FEWEST, int(len(points) * (gap / max(gaps)) ** 2))]
        for points, gap in zip(parts, gaps, strict=True)
    ]
