"""How far long work is, told through Python's logging.

Whoever works announces its stages and knows nobody who listens, so no result can depend on who does. `Listener` shows
what is announced: as a bar where a rich display is on the screen, in lines where none is.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, NamedTuple, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_LOGGER = "articulate_ssl"  # the parent of the loggers of all our modules
_LINE_EVERY = 10.0  # seconds between two lines about one work, where a line cannot be replaced by the next

Item = TypeVar("Item")


class Stage(NamedTuple):
    """Of some work.

    Attributes:
        work: What is done, as a user would say it: `part discovery`.
        name: What of it begins now.
        done: So many stages are done; all of them when the work is.
        total: So many there are, of roughly the same length.
    """

    work: str
    name: str
    done: int
    total: int


def announce(log: logging.Logger, stage: Stage) -> None:
    """Tell listeners that a stage begins, or that the work is done. What is logged between, they take for details."""
    log.info("%s: %s", stage.work, stage.name, extra={"stage": stage})


def announced(log: logging.Logger, work: str, items: Sequence[Item]) -> Iterator[Item]:
    """The items one by one, telling listeners how many are done."""
    for done, item in enumerate(items):
        announce(log, Stage(work, "", done, len(items)))
        yield item
    announce(log, Stage(work, "", len(items), len(items)))


def tell(log: logging.Logger, message: str, *values: object) -> None:
    """Tell listeners what work has found: a line that stays, while details go with the work that they are of.

    Args:
        values: As of `logging`.
    """
    log.info(message, *values, extra={"stays": True})


@dataclass
class _Shown:
    """A work that is under way: when it began, when a line was last written, its task on the display."""

    begun: float
    written: float = -float("inf")
    task: TaskID | None = None
    title: str = ""


class Listener(logging.Handler):
    """Shows what is announced, and writes out what was found, and warnings.

    Args:
        display: Gives the rich display that is on the screen, None where there is none.
    """

    def __init__(self, display: Callable[[], Progress | None]) -> None:
        super().__init__(logging.INFO)
        self._display = display
        self._shown: dict[str, _Shown] = {}

    @property
    def working(self) -> bool:
        """Whether announced work is under way."""
        return bool(self._shown)

    def emit(self, record: logging.LogRecord) -> None:
        """One record of the package's loggers."""
        stage: Stage | None = getattr(record, "stage", None)
        if record.levelno >= logging.WARNING or getattr(record, "stays", False):
            _write(record.getMessage())
        elif stage is not None:
            self._show(stage)
        elif self._shown:
            self._show_detail(record.getMessage())

    def end(self) -> None:
        """Take from the display what never came to its end."""
        display = self._display()
        for shown in self._shown.values():
            if display is not None and shown.task in display.task_ids:
                display.remove_task(shown.task)
        self._shown.clear()

    def _show(self, stage: Stage) -> None:
        now, display = time.monotonic(), self._display()
        shown = self._shown.setdefault(stage.work, _Shown(begun=now))
        if stage.done == stage.total:
            self._finish(stage.work, now - shown.begun)
            return
        shown.title = f"{stage.work}: {stage.name}" if stage.name else stage.work
        if display is not None:
            if shown.task not in display.task_ids:  # the first stage, or another display
                shown.task = display.add_task(shown.title, total=stage.total)
            display.update(shown.task, completed=stage.done, description=shown.title)
        elif now - shown.written >= _LINE_EVERY:
            shown.written = now
            _write(f"{shown.title}, {stage.done} of {stage.total} done after {_clock(now - shown.begun)}")

    def _show_detail(self, text: str) -> None:
        display, shown = self._display(), next(reversed(self._shown.values()))
        if display is not None and shown.task in display.task_ids:
            display.update(shown.task, description=f"{shown.title}, {text}")

    def _finish(self, work: str, seconds: float) -> None:
        display, shown = self._display(), self._shown.pop(work)
        if display is not None and shown.task in display.task_ids:
            display.remove_task(shown.task)
        _write(f"{work}: took {_clock(seconds)}")


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within the block, the listener shows what this package announces."""
    logger = logging.getLogger(_LOGGER)
    level = logger.level
    logger.addHandler(listener)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(listener)
        listener.end()


@contextmanager
def shown() -> Iterator[None]:
    """Within the block, what this package announces is shown on standard error.

    For commands that have no display of their own; training has Lightning's.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as display:
        listener = Listener(lambda: display if console.is_terminal else None)
        with listening(listener):
            yield


def _write(line: str) -> None:
    # A display on the screen redirects standard error, and keeps below what is written.
    print(line, file=sys.stderr, flush=True)


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
