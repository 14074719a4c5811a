"""Long work in stages: programs of their own, whose words go to log files, and notes of what they have finished.

A stage that finished is not repeated; one that was cut off, wherever, is begun again or goes on, and its time counts
from its first attempt. No two run in a folder at once, not even when what started one was killed and it was not.
"""

from __future__ import annotations

import fcntl
import json
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datamodules.atomic import atomic_write

_NOTE_EVERY = 5.0  # seconds; so much of the time that was spent is forgotten at most if this process is killed


class StageFailed(RuntimeError):
    """A stage ended with an error; the message names it and its log."""


@dataclass(frozen=True)
class Stage:
    """One step to a result.

    Attributes:
        name: For example `data`, `fit` or `test`; of its log and its note.
        command: Words of the program.
    """

    name: str
    command: tuple[str, ...]


@dataclass(frozen=True)
class Workplace:
    """A folder in which stages run one after the other.

    Attributes:
        title: Of what is made, for people.
        folder: Of logs and notes.
    """

    title: str
    folder: Path

    def begun(self, stage: Stage) -> bool:
        """Whether this very command ran here last, to its end or not."""
        return bool(self._noted(stage))

    def seconds(self, stage: Stage) -> float | None:
        """How long this very command took, over all attempts; None if it is not finished."""
        return self._noted(stage).get("seconds")

    def log(self, stage: Stage) -> Path:
        """What its program said."""
        return self.folder / f"{stage.name}.log"

    def run(self, stage: Stage, say: Callable[[str], None], more: Sequence[str] = ()) -> None:
        """Run a stage to its end.

        Args:
            stage: What to run.
            say: Told of its beginning and end, in a line each.
            more: Words behind the command that make it go on where it was cut off, not noted; with any, the time it
                took before counts.

        Raises:
            StageFailed: if the program fails.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._alone(say) as lock:
            spent = self._noted(stage).get("spent", 0.0) if more else 0.0
            start = time.monotonic()

            def tick(seconds: float | None = None) -> None:
                self._note(stage, seconds, spent + time.monotonic() - start)

            tick()
            say(f"{self.title}: {stage.name} … ({self.log(stage)})")
            code = run_program([*stage.command, *more], self.log(stage), lock, tick)
            if code:
                raise StageFailed(
                    f"{self.title}: {stage.name} failed with exit code {code}; {self.log(stage)} says why"
                )
            seconds = spent + time.monotonic() - start
            tick(seconds)
            say(f"{self.title}: {stage.name} took {round(seconds)} s")

    def finished(self, stage: Stage, seconds: float) -> None:
        """Note a stage that is no program."""
        self._note(stage, seconds, seconds)

    @contextmanager
    def _alone(self, say: Callable[[str], None]) -> Iterator[int]:
        """Hold the folder's lock, which the program inherits: it is free once both have ended, however they end."""
        with (self.folder / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                say(f"{self.title}: waiting for the end of another run in {self.folder} …")
                fcntl.flock(file, fcntl.LOCK_EX)
            yield file.fileno()

    def _noted(self, stage: Stage) -> dict[str, Any]:
        file = self.folder / f"{stage.name}.json"
        note = json.loads(file.read_text()) if file.is_file() else {}
        # Of whichever environment the interpreter is: work in a shared folder goes on from another checkout.
        return note if note.get("command", [])[1:] == list(stage.command)[1:] else {}

    def _note(self, stage: Stage, seconds: float | None, spent: float) -> None:
        with atomic_write(self.folder / f"{stage.name}.json") as file:
            file.write(json.dumps({"command": stage.command, "seconds": seconds, "spent": spent}).encode())


def run_program(command: Sequence[str], log: Path, lock: int, tick: Callable[[], None]) -> int:
    """Run a program whose words go to `log` and which holds the file `lock`; returns its exit code."""
    with log.open("w") as output:
        program = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, pass_fds=(lock,))
        try:
            while True:
                try:
                    return program.wait(_NOTE_EVERY)
                except subprocess.TimeoutExpired:
                    tick()
        except BaseException:
            program.terminate()
            program.wait()
            raise
