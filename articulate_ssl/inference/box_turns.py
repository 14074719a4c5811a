"""Which way round a box with a door is, also where the door is closed: what looks right says it, not what fits.

Training shows doors that are open. Nearly closed, a box fits its cloud as well any way round, once it may take other
proportions; of ovens whose doors were 0 to 20 degrees open half were explained wrongly (docs/experiments.md, step 274).
But where parts and joints are, predictions of open ones mostly know, and a door that is known can be closed in the
cloud: complete clouds show a closed door's other side, too. So a network learns how boxes look with doors as far as
closed (`training/box_lessons.py`), though no cloud showed any. A box's faces are square to the axes of its cloud's
Manhattan frame, which leaves 24 rotations, and the network says which of them looks right.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.surface_decision import WithSurface


class BoxTurns(WithSurface):
    """See above.

    Attributes:
        axes: [3, 3] columns: of the frame in which boxes look right, in canonical space.
        surface: How right clouds look in a frame; None if it was not taught.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("axes", torch.eye(3))

    @property
    def learnt(self) -> bool:
        """Whether the network was taught."""
        return self.surface is not None

    @torch.no_grad()
    def looks(
        self,
        dense: Tensor,  # [B, P, 3] farthest-point order
        frames: Tensor,  # [B, 3, 3] camera -> frame of the clouds (`manhattan_frames`)
    ) -> tuple[Tensor, Tensor]:  # [B, 24, 3, 3], [B, 24]
        """Rotations canonical object space -> camera, and logarithms of the probabilities that a box is turned so.

        A box that is hinged at another side than most stands as these do, and not as its hinge does.
        """
        every = frames.mT[:, None] @ rotation_group(24).elements.to(frames)
        looks = self.surface.looks_right(every, dense) / self.surface.temperature
        return every @ self.axes.mT.to(frames), looks.log_softmax(dim=1)
