"""Pose (paper, Sec. 3.2): base transformation and joint states, once per group element."""

from __future__ import annotations

import roma
import torch
from torch import Tensor, nn

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.network.heads.perceptron import perceptron
from articulate_ssl.network.options import NetworkOptions


class PoseHead(nn.Module):
    """Of every part a base and a state head; the root's base and the states of the others are read.

    Every group element has a hypothesis for each of A combinations of joint states that estimation starts from.
    """

    def __init__(self, num_parts: int, group: RotationGroup, state_bound: float, options: NetworkOptions) -> None:
        """Args: K; the rotations that hypotheses start from; largest joint state; channels."""
        super().__init__()
        self.state_bound = state_bound
        self.register_buffer("elements", group.elements, persistent=False)
        anchors = state_anchors(options.state_anchors or 0, num_parts - 1, state_bound)
        self.register_buffer("anchors", anchors, persistent=False)
        self.state_step = state_bound / max(1, options.state_anchors or 0)  # half of either neighbour's stretch, too
        dim, count = options.head_dim, len(anchors)
        self.base = nn.ModuleList(perceptron(2 * dim, dim, 6 * count) for _ in range(num_parts))
        self.state = nn.ModuleList(perceptron(2 * dim, dim, count) for _ in range(num_parts))

    def forward(
        self,
        equivariant: Tensor,  # [B, K, G, 2D] part features
        chain: KinematicChain,
        mean: Tensor,  # [B, 1, 3] of the cloud, which rotations turn it about
        residual: bool = False,
    ) -> tuple[Tensor, Tensor]:  # [B, G A, 4, 4] and [B, G A, J], the A of a group element side by side
        """Base poses and joint states; or, with `residual`, changes of states that were estimated before."""
        state = self.joint_state(equivariant, chain, residual)
        return self.base_pose(equivariant, chain, mean), state

    def base_pose(self, equivariant: Tensor, chain: KinematicChain, mean: Tensor) -> Tensor:
        """Group element x predicted residual, about the cloud's mean, [B, G A, 4, 4]."""
        residual = self.base[chain.root](equivariant[:, chain.root]).unflatten(-1, (-1, 6))
        elements = self.elements.to(residual)
        translation = torch.einsum("gij,bgaj->bgai", elements, residual[..., 3:]) + mean[:, None]
        rotation = elements[:, None] @ roma.rotvec_to_rotmat(residual[..., :3])
        return se3(rotation, translation).flatten(1, 2)

    def joint_state(self, equivariant: Tensor, chain: KinematicChain, residual: bool = False) -> Tensor:
        """Each from the features of the part that the joint moves, [B, G A, J]."""
        out = [self.state[k](equivariant[:, k]).unbind(dim=-1) for k in chain.child]
        state = torch.stack([torch.stack(start, dim=-1) for start in zip(*out, strict=True)], dim=2)  # [B, G, A, J]
        if residual:
            return (self.state_bound * state.tanh()).flatten(1, 2)
        return (self.anchors.to(state) + self.state_step * state.tanh()).flatten(1, 2)


def state_anchors(count: int, joints: int, bound: float) -> Tensor:  # [A, J]
    """Joint states to start from: for every joint the middles of `count` equal stretches of [0, bound]."""
    if count == 0:
        return torch.zeros(1, joints)
    middles = bound * (torch.arange(count) + 0.5) / count
    return torch.cartesian_prod(*[middles] * joints).view(-1, joints)
