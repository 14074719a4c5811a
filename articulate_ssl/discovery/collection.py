"""The clouds of a category as part discovery works on them: in one frame, if they have one, and with a registrar."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.discovery.common_frame import common_frame
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registrar import Registrar, SearchingRegistrar, SlidingRegistrar
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.observation import Observation


@dataclass(frozen=True)
class Collection:
    """n clouds, and how shapes are registered to them.

    Attributes:
        clouds: [n, dense_points, 3] in their common frame, if they have one.
        few: Those on which labels and joints are solved.
        frame: [n, 3, 3] that turned the clouds into the common frame; None where they stand as they were given.
        rotations: [H, 3, 3] from which clouds that have no common frame are registered.
        registrar: Of shapes to clouds.
    """

    clouds: Tensor
    few: Tensor
    frame: Tensor | None
    rotations: Tensor
    registrar: Registrar

    @staticmethod
    def of(
        clouds: Tensor,  # [n, N, 3] in any orientation
        joint_type: int,
        options: DiscoveryOptions,
        observation: Observation,
    ) -> Collection:
        """Look for a common frame where joints slide, and choose the registrar by that."""
        generator = torch.Generator().manual_seed(options.seed)
        # Sliding says nothing about orientation, while free registration of what slides turns it wherever it likes.
        slides = joint_type == PRISMATIC and not observation.orientation.limited
        frame = common_frame(clouds, generator, observation.bidirectional) if slides else None
        clouds = clouds[:, : options.dense_points].contiguous()
        rotations = rotation_group(60).elements.to(clouds)
        rotations = rotations[observation.orientation.contains(rotations)]
        registrar = SearchingRegistrar(options, generator, rotations, observation)
        if frame is not None:
            clouds, registrar = clouds @ frame.mT, SlidingRegistrar(options, generator)
        few = clouds[:: max(1, len(clouds) // options.search_clouds)][: options.search_clouds]
        return Collection(clouds, few, frame, rotations, registrar)

    def as_given(self, found: RegisteredShape, rows: slice = slice(None)) -> RegisteredShape:
        """What was registered to all clouds, or some, to the clouds as they were given."""
        if self.frame is None:
            return found
        back = self.frame[rows].mT
        return replace(found, base=se3(back, back.new_zeros(3)) @ found.base)
