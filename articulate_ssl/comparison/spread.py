"""Doing jobs: one after the other, several at once on this machine, or on the machines of a Dask cluster."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event, Lock, Thread

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from articulate_ssl.comparison.jobs import Job
from articulate_ssl.pretrained.stages import StageFailed

_LOOK_EVERY = 1.0  # seconds
_LINE_EVERY = 60.0  # seconds between two lines about one job, where a line cannot be replaced by the next
_TAIL = 4096  # bytes of a log in which its last line begins
_WIDTH = 90  # characters of that line


def do_jobs(
    jobs: Sequence[Job],
    workers: int,
    scheduler: str | None = None,
    done: Callable[[Job], None] = lambda job: None,
) -> dict[Job, str]:
    """Do all; one that fails does not stop the others.

    A job is a program of its own, so threads of this process, which wait for them, are workers enough.

    Args:
        jobs: What to do.
        workers: So many at once on this machine.
        scheduler: Address of a Dask scheduler (`tcp://…`) to use instead; its workers must see the same folders and
            have this package.
        done: Called for each that did not fail, as soon as it is finished.

    Returns:
        Why some failed.

    Raises:
        ValueError: if there is no Dask, or the scheduler cannot be reached.
    """
    with _shown() as lines:
        if scheduler is not None:
            return _on_cluster(jobs, scheduler, lines, done)
        failed = {}
        with ThreadPoolExecutor(workers) as pool:
            futures = {pool.submit(_watched, job, lines): job for job in jobs}
            try:
                for future in as_completed(futures):
                    _collect(future, futures[future], failed, lines, done)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return failed


@dataclass
class _Lines:
    """One line for each job that is under way: its log's last."""

    display: Progress
    say: Callable[[str], None]
    at_work: dict[Job, float] = field(default_factory=dict)  # when each was last written about
    lock: Lock = field(default_factory=Lock)
    stopped: Event = field(default_factory=Event)

    def follow(self) -> None:
        tasks = {}
        while not self.stopped.wait(_LOOK_EVERY):
            with self.lock:
                for job in set(tasks) - set(self.at_work):
                    self.display.remove_task(tasks.pop(job))
                for job in self.at_work:
                    if self.display.disable:
                        self._write(job)
                        continue
                    if job not in tasks:
                        tasks[job] = self.display.add_task("", total=None)
                    self.display.update(tasks[job], description=f"{job.title}: {_last_line(job)}")

    def _write(self, job: Job) -> None:
        now = time.monotonic()
        if now - self.at_work[job] >= _LINE_EVERY:
            self.at_work[job] = now
            self.say(f"{job.title}: {_last_line(job)}")


@contextmanager
def _shown():
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as display:
        lines = _Lines(display, lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True))
        thread = Thread(target=lines.follow, daemon=True)
        thread.start()
        try:
            yield lines
        finally:
            lines.stopped.set()
            thread.join()


def _watched(job: Job, lines: _Lines) -> None:
    with lines.lock:
        lines.at_work[job] = time.monotonic()
    try:
        job.make(lines.say)
    finally:
        with lines.lock:
            del lines.at_work[job]


def _collect(future: Future, job: Job, failed: dict[Job, str], lines: _Lines, done: Callable[[Job], None]) -> None:
    try:
        future.result()
    except (StageFailed, OSError) as error:
        failed[job] = str(error)
        lines.say(str(error))
    else:
        done(job)


def _on_cluster(jobs: Sequence[Job], scheduler: str, lines: _Lines, done: Callable[[Job], None]) -> dict[Job, str]:
    try:
        from dask.distributed import Client
        from dask.distributed import as_completed as as_done
    except ImportError as error:
        raise ValueError("--scheduler needs Dask: pip install 'articulate-ssl[dask]'") from error
    failed = {}
    try:
        client = Client(scheduler)
    except OSError as error:
        raise ValueError(f"{scheduler}: no Dask scheduler answers there ({error})") from error
    with client:
        # Not pure: a job whose files were deleted must be done again, whatever Dask remembers of it.
        futures = {client.submit(_make, job, pure=False): job for job in jobs}
        for future in as_done(futures):
            job = futures[future]
            _collect(future, job, failed, lines, done)
            if job not in failed:
                lines.say(f"{job.title}: done")
    return failed


def _make(job: Job) -> None:
    job.make()


def _last_line(job: Job) -> str:
    """What the program of a job said last."""
    logs = [log for stage in job.stages() if (log := job.work.log(stage)).is_file()]
    if not logs:
        return "…"
    with max(logs, key=lambda log: log.stat().st_mtime).open("rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - _TAIL))
        lines = file.read().decode(errors="replace").replace("\r", "\n").split("\n")
    return next((line.strip()[:_WIDTH] for line in reversed(lines) if line.strip()), "…")
