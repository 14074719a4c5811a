"""Slot attention over points (Locatello et al. 2020) with one learned start per slot, so slots keep their order."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SlotAttention(nn.Module):
    """Groups M point features into K slots that compete for the points.

    Every slot starts from its own learned vector instead of a random draw: slot k means the same part in every cloud
    of the category, and the grouping is deterministic.
    """

    def __init__(self, in_dim: int, num_slots: int, slot_dim: int = 64, iterations: int = 3) -> None:
        super().__init__()
        self.iterations = iterations
        self.scale = slot_dim**-0.5
        self.start = nn.Parameter(torch.randn(num_slots, slot_dim))
        self.norm_input = nn.LayerNorm(in_dim)
        self.norm_slot = nn.LayerNorm(slot_dim)
        self.norm_update = nn.LayerNorm(slot_dim)
        self.to_key = nn.Linear(in_dim, slot_dim, bias=False)
        self.to_value = nn.Linear(in_dim, slot_dim, bias=False)
        self.to_query = nn.Linear(slot_dim, slot_dim, bias=False)
        self.gru = nn.GRUCell(slot_dim, slot_dim)
        self.mlp = nn.Sequential(nn.Linear(slot_dim, 2 * slot_dim), nn.ReLU(), nn.Linear(2 * slot_dim, slot_dim))

    def forward(self, features: Tensor) -> Tensor:
        """Logits [B, M, K] of every point for every slot, from invariant point features [B, M, C].

        Their softmax over K is the association W of the last round.
        """
        batch = features.shape[0]
        features = self.norm_input(features)
        key, value = self.to_key(features), self.to_value(features)
        slots = self.start.expand(batch, -1, -1)
        for step in range(self.iterations):
            query = self.to_query(self.norm_slot(slots))
            logits = torch.einsum("bmc,bkc->bmk", key, query) * self.scale
            if step + 1 == self.iterations:
                break
            attention = logits.softmax(dim=-1) + 1e-8
            attention = attention / attention.sum(dim=1, keepdim=True)
            update = torch.einsum("bmk,bmc->bkc", attention, value)
            slots = self.gru(update.flatten(0, 1), slots.flatten(0, 1)).view_as(slots)
            slots = slots + self.mlp(self.norm_update(slots))
        return logits
