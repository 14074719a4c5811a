"""How long each stage of training takes, and how fast it learns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScheduleOptions:
    """Steps and learning rates.

    Attributes:
        steps: Length of the schedule; the trainer's `max_steps` says when to stop.
        rigid_steps: Steps of stage 0, rigid alignment of the whole shape, before the articulated network trains.
        warmup_steps: Steps on registered clouds alone, with the category's shapes and joints held (staged recipe).
        learning_rate: Of Adam.
        decay: The learning rate is multiplied by this every `decay_every` steps (paper recipe).
        decay_every: See above.
        final_rate: Share of the learning rate that is left at the end of its cosine (staged recipe).
        category_rate: Learning rate of category-level shapes and joints relative to the networks' (staged recipe).
    """

    steps: int = 10_000
    rigid_steps: int = 0
    warmup_steps: int = 4_000
    learning_rate: float = 1e-4
    decay: float = 0.7
    decay_every: int = 1000
    final_rate: float = 0.02
    category_rate: float = 0.1
