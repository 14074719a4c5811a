"""A source is read whole before anything is made of it, so that all that is broken in it is named at once."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from render.execution import Task, run_tasks
from render.progress import with_progress
from render.shard_task import Reading

Read = TypeVar("Read", bound=Reading)


def read_all(
    checks: Sequence[Task[Read]], workers: int, scheduler: str | None, description: str
) -> dict[str, Read]:  # by name, sorted
    """What came of every check, in parallel and with a progress bar."""
    results = with_progress(run_tasks(list(checks), workers, scheduler), len(checks), description)
    return {reading.name: reading for reading in sorted(results, key=lambda reading: reading.name)}


def broken(readings: dict[str, Reading], root: str, kind: str, skip: bool) -> dict[str, str]:
    """Why, by name, some cannot be used; file names in it are relative to the root, wherever that lies.

    Args:
        readings: By name.
        root: Folder that was read.
        kind: What they are called, in the plural.
        skip: Whether to go on without them.

    Raises:
        ValueError: naming every one, if there is any and they are not to be skipped, or nothing is left.
    """
    problems = {name: reading.problem for name, reading in readings.items() if reading.problem}
    folder = os.path.join(Path(root), "")  # as messages have it, without ./ or a second /
    if problems and (not skip or len(problems) == len(readings)):
        remedy = "repair or remove them"
        remedy += ", or leave them out with --skip-broken" if len(problems) < len(readings) else ""
        # A path below the root names its object; any other message could be about any of them.
        named = (folder, f"{Path(root)}: ")
        listed = [problem if problem.startswith(named) else f"{name}: {problem}" for name, problem in problems.items()]
        raise ValueError(
            f"{len(problems)} of {len(readings)} {kind} in {root} cannot be used; {remedy}, and repeat the command:"
            + "".join(f"\n  {problem}" for problem in listed)
        )
    return {name: f"broken: {problem.replace(folder, '')}" for name, problem in problems.items()}
