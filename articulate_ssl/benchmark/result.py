"""What a measurement gives: a row of the table, and mostly a number of bench.json."""

from __future__ import annotations

import statistics
from dataclasses import dataclass


@dataclass
class Result:
    """A measured number with its spread.

    Attributes:
        key: name in bench.json, or None for a row of the table only.
        label: row of the table.
        values: repetitions.
        unit: after the number.
    """

    key: str | None
    label: str
    values: list[float]
    unit: str = ""

    @property
    def median(self) -> float:
        """Median of the repetitions."""
        return statistics.median(self.values)
