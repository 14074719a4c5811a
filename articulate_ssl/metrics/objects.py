"""Of which test objects the errors are: a mean over hundreds of clouds hides that one object has most of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from torch import Tensor

CSV_NAME = "objects.csv"
NUMBER, CLOUDS = "instance", "samples"  # besides errors, what is known of every object
_ORDER = "r_err_deg"
_NAMED = 5  # objects at most that a sentence names


def as_csv(
    objects: dict[str, Tensor],  # of `ArticulatedPoseMetrics.per_object`
    names: Sequence[str],  # object ids, at which `instance` points
) -> str:
    """One line per object, the worst rotations first: its id, its clouds, and means of every error over them."""
    errors = [name for name in objects if name not in (NUMBER, CLOUDS)]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["object", CLOUDS, *errors])
    for row in objects[_ORDER].argsort(descending=True, stable=True).tolist():
        means = [float(objects[name][row]) for name in errors]
        shown = ["" if mean != mean else mean for mean in means]
        writer.writerow([names[int(objects[NUMBER][row])], int(objects[CLOUDS][row]), *shown])
    return text.getvalue()


def half_of_flips(
    objects: dict[str, Tensor],  # of `ArticulatedPoseMetrics.per_object`
    names: Sequence[str],
) -> str | None:
    """A sentence that names the fewest objects which have half of the flips; None without flips."""
    flips = (objects["flip_rate"] * objects[CLOUDS]).round().int()
    if not (total := int(flips.sum())):
        return None
    order = flips.argsort(descending=True, stable=True)
    count = int((flips[order].cumsum(0) * 2 < total).sum()) + 1
    named = [names[i] for i in objects[NUMBER][order[:count]].tolist()]
    more = f" and {count - _NAMED} more" if count > _NAMED else ""
    share = int(flips[order[:count]].sum())
    return f"{share} of {total} flips are of {count} of {len(flips)} objects: {', '.join(named[:_NAMED])}{more}"
