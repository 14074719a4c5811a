"""Running tasks: in this process, in worker processes, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol, TypeVar

# Read by the numerical libraries when a worker imports them: parallelism comes from workers, not from threads.
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")}

_START_METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"

Result = TypeVar("Result", covariant=True)


class Task(Protocol[Result]):
    """A piece of work that can be sent to another process."""

    def make(self) -> Result:
        """Do it."""


def run_tasks(tasks: list[Task[Result]], workers: int, scheduler: str | None = None) -> Iterator[Result]:
    """Results in the order in which they finish. The first error of a task ends the run.

    Args:
        tasks: What to make.
        workers: Number of processes; 1 works in the calling process.
        scheduler: Address of a Dask scheduler (`tcp://…`) to use instead; its workers must see the same folders, and
            have one thread each.

    Raises:
        ValueError, OSError: from a task, or if the scheduler cannot be reached.
    """
    if scheduler is not None:
        yield from _run_dask(tasks, scheduler)
    elif workers == 1 or len(tasks) < 2:
        yield from map(_make, tasks)
    else:
        yield from _run_pool(tasks, workers)


def _make(task: Task[Result]) -> Result:
    return task.make()


def _run_pool(tasks: list[Task[Result]], workers: int) -> Iterator[Result]:
    # Not fork: a fork after a GL context was used hangs. The fork server is a fresh process that only imports.
    context = multiprocessing.get_context(_START_METHOD)
    if _START_METHOD == "forkserver":
        context.set_forkserver_preload(sorted({__name__, *(type(task).__module__ for task in tasks)}))
    previous = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        with ProcessPoolExecutor(min(workers, len(tasks)), mp_context=context, initializer=_end_with_parent) as pool:
            futures = [pool.submit(_make, task) for task in tasks]
            try:
                for future in as_completed(futures):
                    yield future.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a worker process was killed, most often for lack of memory; repeat the command to continue, with fewer "
            "--workers"
        ) from error
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """Let this worker die when its parent is killed; it would wait for work, or write, forever."""
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _run_dask(tasks: list[Task[Result]], scheduler: str) -> Iterator[Result]:
    try:
        from dask.distributed import Client, as_completed
    except ImportError as error:
        raise ValueError("--scheduler needs Dask: pip install 'articulate-ssl[dask]'") from error
    with Client(scheduler) as client:
        # Not pure: a shard that was deleted must be written again, whatever Dask remembers of it.
        futures = client.map(_make, tasks, pure=False)
        for _, result in as_completed(futures, with_results=True):
            yield result
