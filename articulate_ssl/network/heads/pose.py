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
    """Of every part a base and a state head; the root's base and the states of the others are read."""

    def __init__(self, num_parts: int, group: RotationGroup, state_bound: float, options: NetworkOptions) -> None:
        """Args: K; the rotations that hypotheses start from; largest joint state; channels."""
        super().__init__()
        self.state_bound = state_bound
        self.register_buffer("elements", group.elements, persistent=False)
        dim = options.head_dim
        self.base = nn.ModuleList(perceptron(2 * dim, dim, 6) for _ in range(num_parts))
        self.state = nn.ModuleList(perceptron(2 * dim, dim, 1) for _ in range(num_parts))

    def forward(
        self,
        equivariant: Tensor,  # [B, K, G, 2D] part features
        chain: KinematicChain,
        mean: Tensor,  # [B, 1, 3] of the cloud, which rotations turn it about
    ) -> tuple[Tensor, Tensor]:  # [B, G, 4, 4] and [B, G, J]
        """Base poses and joint states."""
        state = self.joint_state(equivariant, chain)
        return self.base_pose(equivariant, chain, mean), state

    def base_pose(self, equivariant: Tensor, chain: KinematicChain, mean: Tensor) -> Tensor:
        """Group element x predicted residual, about the cloud's mean, [B, G, 4, 4]."""
        residual = self.base[chain.root](equivariant[:, chain.root])
        elements = self.elements.to(residual)
        translation = torch.einsum("gij,bgj->bgi", elements, residual[..., 3:]) + mean
        return se3(elements @ roma.rotvec_to_rotmat(residual[..., :3]), translation)

    def joint_state(self, equivariant: Tensor, chain: KinematicChain) -> Tensor:
        """Each from the features of the part that the joint moves, [B, G, J]."""
        state = [self.state[k](equivariant[:, k])[..., 0] for k in chain.child]
        return self.state_bound * torch.stack(state, dim=-1).tanh()
