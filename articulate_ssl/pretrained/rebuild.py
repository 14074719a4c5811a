"""`make weights`: every set of shipped weights from nothing, by the commands that the cards state.

For each category and view: data, fit, test, pack. Each is a program of its own, whose words go to a log file; a stage
that has finished leaves a note of its command and is not repeated, and a fit that was cut off goes on from its last
checkpoint. Data are deleted once their weights are packed: all of them would fill ten gigabytes.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.pretrained.pack import VIEW_OF_DATA, fit_command, newest_metrics, pack
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER
from articulate_ssl.training.weights_card import CARD_SUFFIX
from articulate_ssl.training.weights_file import SUFFIX
from datamodules.atomic import atomic_write

# All but laptop_real, whose objects are laptops.
CATEGORIES = ("laptop", "oven", "eyeglasses", "washing_machine", "safe", "drawer", "desk_lamp")
DATA_SEED = 11  # no other: README's numbers are of 1 to 4
FIT_SEED = 0
DEPTH_OPTIONS = ("--states", "30", "--views", "4")  # more states and views teach no more, and take longer


class StageFailed(RuntimeError):
    """A stage ended with an error; the message names it and its log."""


@dataclass(frozen=True)
class Stage:
    """One step to a set of weights.

    Attributes:
        name: `data`, `fit` or `test`.
        command: Words of the program.
    """

    name: str
    command: tuple[str, ...]


@dataclass(frozen=True)
class Rebuild:
    """How one set of weights is made.

    Attributes:
        category: Category name.
        view: `complete` or `depth`.
        build: Folder for data, runs and logs of all of them.
        folder: Where weights and cards go.
    """

    category: str
    view: str
    build: Path
    folder: Path = WEIGHTS_FOLDER

    @property
    def name(self) -> str:
        """Of the weights."""
        return f"{self.category}-{self.view}"

    @property
    def place(self) -> Path:
        """Of logs, notes and the run."""
        return self.build / self.name

    @property
    def data_root(self) -> Path:
        """Of its own, so that it can be deleted alone."""
        return self.place / "data"

    def stages(self) -> tuple[Stage, ...]:
        """The programs, in their order."""
        view = next(data_view for data_view, view in VIEW_OF_DATA.items() if view == self.view)
        options = DEPTH_OPTIONS if self.view == "depth" else ()
        made = ("--category", self.category, "--view", view, "--seed", str(DATA_SEED), "--workers", "1", *options)
        _, fit, *learn = fit_command(self.category, self.view, FIT_SEED)
        places = ("--data.root", str(self.data_root), "--trainer.default_root_dir", str(self.place / "run"))
        ours = (sys.executable, "-m", "articulate_ssl.cli")
        return (
            Stage("data", (sys.executable, "-m", "render.generate", *made, "--out", str(self.data_root))),
            Stage("fit", (*ours, fit, *learn, *places, "--trainer.enable_progress_bar", "false")),
            Stage("test", (*ours, "test", *learn, *places, "--trainer.enable_progress_bar", "false")),
        )

    def run(self, say: Callable[[str], None]) -> None:
        """Do what is not done yet, and say one line about each stage.

        Raises:
            StageFailed: if a program fails; what is finished stays.
            CheckpointError: if the run cannot be packed.
        """
        stages = self.stages()
        if all(self._noted(stage).get("seconds") is not None for stage in stages) and self._written():
            say(f"{self.name}: done before")
            return
        self.place.mkdir(parents=True, exist_ok=True)
        again = False
        for stage in stages:
            again = self._do(stage, again, say)
        pack(newest_metrics(self.place / "run"), commit=commit_of(Path.cwd()), folder=self.folder)
        shutil.rmtree(self.data_root)
        say(f"{self.name}: packed")

    def _do(self, stage: Stage, again: bool, say: Callable[[str], None]) -> bool:
        """Run a stage if it is not done, or `again`; whether those behind it must run again."""
        note = self._noted(stage)
        finished = note.get("seconds") is not None and not again
        if finished and (stage.name != "data" or self.data_root.is_dir()):
            say(f"{self.name}: {stage.name} done before")
            return False
        command = list(stage.command)
        if stage.name == "fit":
            command += self._resumed(begun=bool(note) and not again)
        self._note(stage, None)
        log, start = self.place / f"{stage.name}.log", time.monotonic()
        say(f"{self.name}: {stage.name} … ({log})")
        with log.open("w") as output:
            code = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False).returncode
        if code:
            raise StageFailed(f"{self.name}: {stage.name} failed with exit code {code}; {log} says why")
        seconds = round(time.monotonic() - start)
        self._note(stage, seconds)
        say(f"{self.name}: {stage.name} took {seconds} s")
        return not finished  # data that were deleted come back the same, byte for byte

    def _resumed(self, begun: bool) -> list[str]:
        """Options of a fit that goes on where this very command was cut off; what another command left is deleted."""
        run = self.place / "run"
        if not begun:
            shutil.rmtree(run, ignore_errors=True)
        last = max(run.glob("**/checkpoints/last.ckpt"), key=lambda path: path.stat().st_mtime, default=None)
        return [] if last is None else ["--ckpt_path", str(last)]

    def _noted(self, stage: Stage) -> dict[str, Any]:
        """What this very command left: `seconds`, None if it was cut off; empty if it never ran."""
        file = self.place / f"{stage.name}.json"
        note = json.loads(file.read_text()) if file.is_file() else {}
        return note if note.get("command") == list(stage.command) else {}

    def _note(self, stage: Stage, seconds: int | None) -> None:
        with atomic_write(self.place / f"{stage.name}.json") as file:
            file.write(json.dumps({"command": stage.command, "seconds": seconds}).encode())

    def _written(self) -> bool:
        return all((self.folder / f"{self.name}{suffix}").is_file() for suffix in (SUFFIX, CARD_SUFFIX))


def rebuild(
    build: Path,
    say: Callable[[str], None],
    categories: Sequence[str] = CATEGORIES,
    views: Sequence[str] = tuple(VIEW_OF_DATA.values()),
    folder: Path = WEIGHTS_FOLDER,
) -> list[str]:
    """Make sets of weights, one after the other; one that fails does not stop the others.

    Returns:
        What failed, in words.
    """
    failed = []
    for view in views:
        for category in categories:
            try:
                Rebuild(category, view, build, folder).run(say)
            except (StageFailed, CheckpointError, OSError) as error:
                failed.append(str(error))
                say(str(error))
    return failed


def commit_of(folder: Path) -> str:
    """The commit of the code in a folder, with a `+` behind it if files were changed since; `unknown` outside git."""
    words = ("git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+")
    try:
        return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
