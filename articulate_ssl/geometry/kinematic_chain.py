"""Kinematic chain: adjacency confidences -> spanning tree -> root -> transformation order -> cascaded motion.

Paper, Sec. 3.2 "Kinematic Chain Prediction" and appendix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import torch
from torch import Tensor


def forward_kinematics(
    motion: Tensor,  # [..., J, 4, 4], each joint's own motion in the object frame at rest
    parent: Sequence[int],  # J part indices
    child: Sequence[int],  # J part indices, each part at most once
    num_parts: int,
) -> Tensor:  # [..., K, 4, 4]
    """Cascaded articulation: the motion of every part when joints act one after another from the root outwards.

    A part's motion is its parent's motion times its own joint's motion, so axes and pivots are all stated in the
    object frame at rest. Parts that no joint moves stay put.

    Raises:
        ValueError: if the joints do not form a forest (a part with two parents, or a cycle).
    """
    if len(set(child)) != len(child):
        raise ValueError(f"a part has two parents: child parts are {list(child)}")
    identity = torch.eye(4, dtype=motion.dtype, device=motion.device).expand(*motion.shape[:-3], 4, 4)
    joint_of = {c: j for j, c in enumerate(child)}
    pose: dict[int, Tensor] = {}

    def resolve(part: int, path: tuple[int, ...]) -> Tensor:
        if part in path:
            raise ValueError(f"the kinematic tree has a cycle through parts {[*path, part]}")
        if part not in pose:
            j = joint_of.get(part)
            pose[part] = identity if j is None else resolve(parent[j], (*path, part)) @ motion[..., j, :, :]
        return pose[part]

    return torch.stack([resolve(part, ()) for part in range(num_parts)], dim=-3)


@dataclass(frozen=True)
class KinematicChain:
    """A rooted spanning tree of K parts; joint j connects `child[j]` to `parent[j]`, the one nearer to the root.

    Attributes:
        num_parts: K.
        root: The base part.
        parent: J = K - 1 part indices.
        child: J part indices, in DFS order from the root.
    """

    num_parts: int
    root: int
    parent: tuple[int, ...]
    child: tuple[int, ...]

    @property
    def transformation_order(self) -> tuple[int, ...]:
        """Joints from the leaves to the root: the inverse DFS visiting order."""
        return tuple(reversed(range(len(self.child))))

    def part_motion(self, motion: Tensor) -> Tensor:
        """[..., J, 4, 4] joint motions in the object frame -> [..., K, 4, 4] cascaded part motions."""
        return forward_kinematics(motion, self.parent, self.child, self.num_parts)


def pair_index(num_parts: int) -> Tensor:
    """[E, 2] part pairs (i, j), i < j, in the order in which pairwise quantities are predicted; E = K(K-1)/2."""
    return torch.combinations(torch.arange(num_parts), 2)


def extract_chain(
    confidence: Tensor,  # [E], larger is more likely adjacent
    num_parts: int,
) -> KinematicChain:
    """Maximum spanning tree of the adjacency confidences, rooted at the part of largest degree (ties: lowest index)."""
    graph = nx.Graph()
    graph.add_nodes_from(range(num_parts))
    for (i, j), value in zip(pair_index(num_parts).tolist(), confidence.tolist(), strict=True):
        graph.add_edge(i, j, weight=value)
    tree = nx.maximum_spanning_tree(graph, weight="weight")
    root = max(range(num_parts), key=lambda k: (tree.degree(k), -k))
    edges = list(nx.dfs_edges(tree, root, sort_neighbors=sorted))
    return KinematicChain(num_parts, root, tuple(p for p, _ in edges), tuple(c for _, c in edges))


def edge_marginals(
    confidence: Tensor,  # [..., E]
    num_parts: int,
) -> Tensor:  # [..., E]
    """Probability that each edge is in a spanning tree drawn with weight exp(sum of its confidences).

    Matrix-tree theorem: the partition function Z is a minor of the weighted graph Laplacian, and the marginal of an
    edge is d log Z / d confidence = weight x effective resistance. Differentiable; sums to K - 1 over the edges.
    """
    pairs = pair_index(num_parts).to(confidence.device)
    weight = (confidence - confidence.amax(dim=-1, keepdim=True)).exp().clamp_min(1e-6)
    incidence = torch.zeros(len(pairs), num_parts, dtype=confidence.dtype, device=confidence.device)
    rows = torch.arange(len(pairs), device=confidence.device)
    incidence[rows, pairs[:, 0]] = 1.0
    incidence[rows, pairs[:, 1]] = -1.0
    reduced = incidence[:, 1:]
    laplacian = torch.einsum("ea,...e,eb->...ab", reduced, weight, reduced)
    resistance = torch.einsum("ea,...ab,eb->...e", reduced, torch.linalg.inv(laplacian), reduced)
    return weight * resistance
