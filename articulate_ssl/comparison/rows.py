"""Rows of the table: what is trained for each, what it is given, and what of its report is its own."""

from __future__ import annotations

from dataclasses import dataclass

from articulate_ssl.baselines import METHODS, method_class
from articulate_ssl.baselines.method import DENSE_CLOUDS, JOINT_LINES, OCCUPANCY, POSES, RECONSTRUCTION, SEGMENTATION
from articulate_ssl.training.columns import NETWORK, NO_NETWORK, REGISTERED, TITLES
from articulate_ssl.training.recipes import RECIPES
from datamodules.manifest import VIEWS

# Recipes whose shape comes from their network: without it, there is nothing to search for.
LEARN_THE_SHAPE = ("paper",)
MULTI_STATE = "multi_state"  # our `staged` recipe in that setting
# Which quantities of a report each word of `Method.says` stands for.
QUANTITIES = {
    SEGMENTATION: ("seg_miou", "legacy_seg_miou"),
    POSES: (
        *("r_err_deg", "flip_rate", "above_30_rate", "t_err", "legacy_r_err_deg", "legacy_t_err"),
        *("chamfer_l1", "legacy_chamfer_l1"),
    ),
    RECONSTRUCTION: ("chamfer_l1", "legacy_chamfer_l1"),
    JOINT_LINES: ("axis_err_deg", "pivot_err", "state_err", "legacy_axis_err_deg", "legacy_pivot_err"),
}


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        name: In files.
        title: In the table.
        learner: Name of what is trained for it, of `learners`; several rows may share one.
        given: What that reads beyond clouds; see `Method.given`.
        quantities: What of the report is its own.
        views: Of which views it is defined.
        column: Of a recipe's report, the way to predict (`training/columns.py`); None for a method.
    """

    name: str
    title: str
    learner: str
    given: tuple[str, ...]
    quantities: tuple[str, ...]
    views: tuple[str, ...] = VIEWS
    column: str | None = None


def learners() -> tuple[str, ...]:
    """Names of all that can be trained and compared: methods, recipes, and the multi-state setting."""
    return (*METHODS, *RECIPES, MULTI_STATE)


def recipe_of(learner: str) -> str | None:
    """The recipe that a learner is trained by; None for a method."""
    return "staged" if learner == MULTI_STATE else learner if learner in RECIPES else None


def rows_of(learner: str) -> list[Row]:
    """The rows that one training is for.

    Raises:
        ValueError: if there is no such learner.
    """
    if recipe_of(learner) is not None:
        columns = (NETWORK, REGISTERED) if learner in LEARN_THE_SHAPE else (NO_NETWORK, NETWORK, REGISTERED)
        everything = tuple(quantity for said in (SEGMENTATION, POSES, JOINT_LINES) for quantity in QUANTITIES[said])
        return [
            Row(
                f"{learner}_{column}",
                f"ours, {learner.replace('_', '-')}: {TITLES[column]}",
                learner,
                # What decides between two explanations after registration reads all points (`inference/two_ways.py`).
                (DENSE_CLOUDS,) if column == REGISTERED else (),
                everything,
                column=column,
            )
            for column in columns
        ]
    if learner not in METHODS:
        raise ValueError(f"methods are {', '.join(learners())}, got {learner!r}")
    method = method_class(learner)
    quantities = tuple(quantity for said in method.says for quantity in QUANTITIES[said])
    return [Row(learner, method.title, learner, method.given, quantities, method.views)]


def needs_occupancy(names: tuple[str, ...]) -> bool:
    """Whether any of these methods or recipes learns from occupancy samples."""
    return any(OCCUPANCY in row.given for name in names for row in rows_of(name))
