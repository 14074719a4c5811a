"""Which way round a box with a door is, also where the door is closed: what looks right says it, not what fits.

Training shows doors that are open. Nearly closed, a box fits its cloud as well any way round, once it may take other
proportions; of ovens whose doors were 0 to 20 degrees open half were explained wrongly (docs/experiments.md, step 274).
But where parts and joints are, predictions of open ones mostly know, and a door that is known can be closed in the
cloud: complete clouds show a closed door's other side, too. So a network learns how boxes look with doors as far as
closed (`training/box_lessons.py`), though no cloud showed any. A box's faces are square to the axes of its cloud's
Manhattan frame, which leaves 24 rotations, and the network says which of them looks right.

In depth views as well, of which a camera that is held upright leaves two on average: scans whose doors were closed are
seen by simulated cameras, and teach it (`training/view_look_lesson.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.alike_boxes import AlikeBoxes
from articulate_ssl.inference.hinge_sides import DECIDED
from articulate_ssl.inference.surface_decision import WithSurface
from articulate_ssl.inference.upright_camera import UprightCamera

# Of depth views, that the network is taught by, and reads. Of nearly closed boxes three views in four of scans of 4,096
# points show as many.
VIEW_POINTS = 640


class Looks(NamedTuple):
    """How right B boxes look in each of the 24 ways that they may be turned.

    Attributes:
        rotation: [B, 24, 3, 3] canonical object space -> camera.
        likely: [B, 24] logarithms of probabilities.
        hinges: [W, 3, 3] turns about the door's normal, of hinges that are elsewhere than most; none comes first.
        log_prior: [W] logarithms of the shares of objects that are hinged so.
        alike: [B, 24] the same as `likely`, by training clouds that are hinged as most are and most alike.
    """

    rotation: Tensor
    likely: Tensor
    hinges: Tensor
    log_prior: Tensor
    alike: Tensor

    @property
    def decided(self) -> Tensor:
        """[B] bool, whether one looks clearly likelier than all others."""
        best = self.likely.topk(2, dim=1).values
        return best[:, 0] - best[:, 1] > DECIDED

    def rows(self, rows: Tensor) -> Looks:
        """Those of some of the boxes."""
        return self._replace(rotation=self.rotation[rows], likely=self.likely[rows], alike=self.alike[rows])

    def of(
        self,
        turn: Tensor,  # [B, C, 3, 3] base rotations
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [B, C], [B, C], [B, C], [B, C]
        """How right what is turned so looks, if it is hinged as most are, or anyhow: 0 for what looks likeliest.

        And how likely it is, by that and by how many are hinged so, and as which of the 24 ways it stands then.
        """
        found, near = self.standing((turn[:, :, None] @ self.hinges.mT).flatten(1, 2))
        found, near = (value.unflatten(1, (turn.shape[1], -1)) for value in (found, near))
        likely, hinged = (found + self.log_prior).max(dim=-1)
        return found[..., 0], found.amax(dim=-1), likely, near.gather(-1, hinged[..., None]).squeeze(-1)

    def standing(
        self,
        turn: Tensor,  # [B, C, 3, 3] base rotations
    ) -> tuple[Tensor, Tensor]:  # [B, C], [B, C]
        """How right what stands so looks, 0 for what looks likeliest, and as which of the 24 ways it stands."""
        near = self._ways(turn)
        likely = self.likely - self.likely.amax(dim=1, keepdim=True)
        return likely.gather(1, near), near

    def like_others(
        self,
        turn: Tensor,  # [B, C, 3, 3] base rotations
    ) -> Tensor:  # [B, C]
        """How like training clouds what is turned so is, 0 for what is most like them."""
        return (self.alike - self.alike.amax(dim=1, keepdim=True)).gather(1, self._ways(turn))

    def _ways(self, turn: Tensor) -> Tensor:
        """As which of the 24 ways what is turned [B, C, 3, 3] stands [B, C]."""
        return torch.einsum("bcij,bgij->bcg", turn, self.rotation).argmax(dim=-1)


class BoxTurns(WithSurface):
    """See above.

    Attributes:
        axes: [3, 3] columns: of the frame in which boxes look right, in canonical space.
        camera: Which way is up for the camera of the views that taught it, where `hinge_sides` does not know that.
        surface: How right clouds look in a frame; None if it was not taught.
        alike: Training clouds to compare with, if some are kept.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("axes", torch.eye(3))
        self.camera = UprightCamera()
        self.alike = AlikeBoxes()

    @property
    def learnt(self) -> bool:
        """Whether the network was taught, or clouds are kept."""
        return self.surface is not None or self.alike.learnt

    @torch.no_grad()
    def looks(
        self,
        dense: Tensor,  # [B, P, 3] farthest-point order
        frames: Tensor,  # [B, 3, 3] camera -> frame of the clouds (`manhattan_frames`)
        hinges: Tensor | None = None,  # [W, 3, 3] see `Looks`; None: none is elsewhere
        log_prior: Tensor | None = None,  # [W]; None: as many are hinged in any of these ways
        seen: Callable[[Tensor], Tensor] | None = None,
    ) -> Looks:
        """How right boxes look.

        One that is hinged at another side than most stands as these do, and not as its hinge does.

        Args:
            seen: Of rotations [B, 24, 3, 3] canonical object space -> camera, whether a camera sees objects turned so
                [B, 24]; None: all of them.
        """
        every = frames.mT[:, None] @ rotation_group(24).elements.to(frames)
        rotation = every @ self.axes.mT.to(frames)
        if self.surface is None:
            looks = dense.new_zeros(every.shape[:2])
        else:
            looks = self.surface.looks_right(every, dense) / self.surface.temperature
        if seen is not None:
            looks = looks.masked_fill(~seen(rotation), -torch.inf)
        hinges = torch.eye(3)[None] if hinges is None else hinges
        log_prior = torch.zeros(len(hinges)) if log_prior is None else log_prior
        alike = self.alike.likely(dense, every)
        return Looks(rotation, looks.log_softmax(dim=1), hinges.to(frames), log_prior.to(frames), alike)
