"""What is known of how a category's clouds are taken, wherever hypotheses about them are drawn, compared or chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from torch import Tensor

from articulate_ssl.geometry.orientation_range import OrientationRange

FAR = 1e3  # more than any distance between normalised clouds


class Upright(Protocol):
    """Which way is up, if that is known (`inference.upright_camera`)."""

    learnt: Tensor

    def stood(self, rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames [..., 3, 3] turned until they stand, by how many quarters, and whether they stand then."""


@dataclass(frozen=True)
class Observation:
    """How clouds show their objects.

    Attributes:
        orientation: How far objects are turned.
        unidirectional: Distances count from the cloud to a hypothesis only, for clouds that do not show all sides.
            Part discovery measures both directions whatever this says.
        camera: Which way is up.
    """

    orientation: OrientationRange = OrientationRange()  # noqa: RUF009 frozen
    unidirectional: bool = False
    camera: Upright | None = None

    @property
    def bidirectional(self) -> bool:
        """Whether a hypothesis pays for what the cloud lacks, too."""
        return not self.unidirectional

    def known(self) -> Observation:
        """The same, without a camera if that has not learnt which way is up."""
        return self if self.camera is None or self.camera.learnt else replace(self, camera=None)

    def allows(
        self,
        rotation: Tensor,  # [..., 3, 3] canonical object space -> camera
    ) -> Tensor:  # [...] bool
        """Whether objects may be turned so; where it is known which way is up, once they stand."""
        if self.camera is None or not self.camera.learnt:
            return self.orientation.contains(rotation)
        rotation, _, stands = self.camera.stood(rotation)
        return stands & self.orientation.contains(rotation)

    def ranked(
        self,
        error: Tensor,  # [...]
        rotation: Tensor,  # [..., 3, 3] of the hypotheses
    ) -> Tensor:  # [...]
        """Errors to choose hypotheses by: those that are turned as no object is come last."""
        return error + FAR * ~self.allows(rotation)
