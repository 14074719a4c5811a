"""What is known of how a category's clouds are taken, wherever hypotheses about them are drawn, compared or chosen."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from articulate_ssl.geometry.orientation_range import OrientationRange

FAR = 1e3  # more than any distance between normalised clouds


@dataclass(frozen=True)
class Observation:
    """How clouds show their objects.

    Attributes:
        orientation: How far objects are turned.
        unidirectional: Distances count from the cloud to a hypothesis only, for clouds that do not show all sides.
            Part discovery measures both directions whatever this says.
    """

    orientation: OrientationRange = OrientationRange()  # noqa: RUF009 frozen
    unidirectional: bool = False

    @property
    def bidirectional(self) -> bool:
        """Whether a hypothesis pays for what the cloud lacks, too."""
        return not self.unidirectional

    def ranked(
        self,
        error: Tensor,  # [...]
        rotation: Tensor,  # [..., 3, 3] of the hypotheses
    ) -> Tensor:  # [...]
        """Errors to choose hypotheses by: those that are turned too far come last."""
        return error + FAR * ~self.orientation.contains(rotation)
