"""What happens at test time after the network."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InferenceOptions:
    """Options of `PoseEstimator`.

    Attributes:
        refine: Register the predicted shape to the cloud from the best hypotheses; null leaves it to the recipe (true
            staged, false paper).
        points: Most points of a cloud that registration reads and labels (a farthest-point prefix). Which way up a
            closed laptop is shows in less than the spacing of the few points that suffice for the networks.
        candidates: Hypotheses that are refined; the best reconstruction wins.
        rounds: Rounds of registration.
        proportions: Cycles of six steps of descent in which a cloud's explanation takes its own proportions in the end
            (`proportions.py`); 0 leaves it to the network. Not where parts slide, whose places similar clouds say.
        most_turned: Degrees by which registration may turn a part from where the network put it; of a hypothesis that
            it turns further, the network's word stays. 180 lets it go anywhere. Where distances count one way, nothing
            in a cloud says that a hidden part is in the wrong place, but the network has seen where they are.
        coarse_scale: First standard deviation of the correspondences, in normalised units.
        fine_scale: Last one.
        part_neighbours: So many points of a posed part say by their mean distance how near it is to a point, which
            belongs to the nearest part; null leaves it to the recipe (1 staged, 6 paper, whose shapes have some points
            on other parts).
        closed_contact: Move hinges of boxes with doors, and of plates, to where the part that turns lies on the other
            when it is closed (`closed_contact.py`); of complete clouds that are registered.
        columns: Report at test time, from the same clouds, what the category's shape without a network reaches, the
            network alone, and the network with registration (`training/columns.py`).
    """

    refine: bool | None = None
    points: int = 512
    candidates: int = 4
    rounds: int = 8
    proportions: int = 25
    most_turned: float = 180.0
    coarse_scale: float = 0.05
    fine_scale: float = 0.02
    part_neighbours: int | None = None
    closed_contact: bool = True
    columns: bool = False
