"""How long each stage of training takes, and how fast it learns."""

from __future__ import annotations

from dataclasses import dataclass

from articulate_ssl.ops.options import require_at_least


@dataclass(frozen=True)
class ScheduleOptions:
    """Steps and learning rates.

    Attributes:
        steps: Length of the schedule; the trainer's `max_steps` says when to stop.
        rigid_steps: Steps of stage 0, rigid alignment of the whole shape, before the articulated network trains.
        warmup_steps: Steps on registered clouds alone, with the category's shapes and joints held (staged recipe).
        learning_rate: Of Adam.
        decay: The learning rate is multiplied by this every `decay_every` steps after stage 0 (paper recipe).
        decay_every: See above.
        final_rate: Share of the learning rate that is left at the end of its cosine (staged recipe).
        balanced_share: Share of the articulated network's steps in which the clouds of a batch are spread evenly over
            the joint states that estimation starts from (paper recipe).
        equal_parts_share: Share of these steps in which parts are drawn to equal shares of every cloud, less and less
            (paper recipe, posterior association).
        agreement_share: Share of these steps before slots have a say in which hypothesis is chosen (paper recipe).
        shared_share: Share of these steps in which all instances have the category's shape; halfway from there to the
            end they have their own (paper recipe).
        category_rate: Learning rate of category-level shapes and joints relative to the networks' (staged recipe).
    """

    steps: int = 10_000
    rigid_steps: int = 0
    warmup_steps: int = 4_000
    learning_rate: float = 1e-4
    decay: float = 0.7
    decay_every: int = 1000
    final_rate: float = 0.02
    balanced_share: float = 0.5
    equal_parts_share: float = 0.3
    agreement_share: float = 0.4
    shared_share: float = 0.5
    category_rate: float = 0.1

    def __post_init__(self) -> None:
        """Raises: ValueError for lengths and rates that there are not."""
        require_at_least(self, "schedule.", steps=1, rigid_steps=0, warmup_steps=0, learning_rate=0, decay_every=1)
