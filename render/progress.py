"""Progress bars of what takes longer than a person waits without wondering."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

Item = TypeVar("Item")


def with_progress(items: Iterable[Item], total: int, description: str) -> Iterator[Item]:
    """The items, with a bar on stderr where that is a terminal."""
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not sys.stderr.isatty()) as progress:
        yield from progress.track(items, total=total, description=description)
