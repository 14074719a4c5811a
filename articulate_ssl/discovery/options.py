"""How much work part discovery does, and which splits it tries."""

from __future__ import annotations

from dataclasses import dataclass, field

PROPOSALS = ("random_cuts", "slabs", "restless_points", "slides")


@dataclass(frozen=True)
class DiscoveryOptions:
    """How much work part discovery does.

    Attributes:
        clouds: Training clouds that are registered.
        split_clouds: The best aligned of them, on which splits are tried.
        search_clouds: Those on which labels and joints are solved again; all are registered in the end.
        points: Points per cloud and template in registration.
        dense_points: The same where it is decided between registrations.
        references: Typical clouds, or `grouped` objects, that are tried as the template. Every second one may be split
            wrongly.
        objects: Of `grouped` objects whose parts slide, those whose parts are found, each from its own clouds.
        proposals: What proposes splits, in this order: modules of `discovery.proposals`, or with dots in their names
            modules from anywhere.
        starts: Random splits of each reference.
        jointed: The refined splits that explain the clouds best, to which joints are fitted.
        rounds: Rounds of articulated search and descent on labels and joints.
        edge_hinges: Also try every revolute joint of the last splits along the edges of the part it moves.
        cycles: Cycles of descent in a round, and on the last splits; a third of them on every split and candidate.
        keep: Share of the clouds, best fitted first, that labels and joints are solved from.
        min_share: Splits with a part smaller than this share of the template are discarded.
        seed: Of the random splits.
        grouped: The multi-state setting: which clouds show the same object is known, and templates are whole objects
            (`discovery.grouped`; for depth views `discovery.from_scans`). An easier problem than the paper's, which
            sees single clouds.
    """

    clouds: int = 192
    split_clouds: int = 24
    search_clouds: int = 64
    points: int = 256
    dense_points: int = 1024
    references: int = 6
    objects: int = 48
    proposals: list[str] = field(default_factory=lambda: list(PROPOSALS))
    starts: int = 12
    jointed: int = 4
    rounds: int = 4
    edge_hinges: bool = True
    cycles: int = 12
    keep: float = 0.75
    min_share: float = 0.05
    seed: int = 0
    grouped: bool = False

    @property
    def few_cycles(self) -> int:
        """Cycles of descent where there are many candidates."""
        return max(1, self.cycles // 3)

    def kept(self, count: int) -> int:
        """Of so many clouds, how many count."""
        return max(1, int(self.keep * count))
