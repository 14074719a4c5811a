"""What shipped weights learn after their training, taught anew: the lessons that have grown since, and the card.

A training is an hour, and what it leaves stays good while what decides and measures afterwards (`training.lessons`)
gets better. So lessons are taught again, by the weights' own training clouds and without labels, or by those of more
objects; the test objects of the card are tested anew. What is finished stays if it is killed, unless the code changes.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.ops.progress import shown
from articulate_ssl.pretrained.check import data_of, tested
from articulate_ssl.pretrained.fingerprint import fingerprint
from articulate_ssl.pretrained.pack import weaknesses
from articulate_ssl.pretrained.rebuild import commit_of
from articulate_ssl.pretrained.stages import Stage, Workplace
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.lessons import LESSONS, teach
from articulate_ssl.training.set_clouds import SetClouds
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER, ShippedWeights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard
from articulate_ssl.training.weights_file import write_weights
from datamodules.atomic import atomic_write
from datamodules.manifest import set_folder

# What a card says of its data beside the command, and which option that is.
_TOLD = {"seed": "--seed", "train_instances": "--train-instances", "test_instances": "--test-instances"}


@dataclass(frozen=True)
class Teaching:
    """Lessons for one set of weights.

    Attributes:
        weights: Which.
        lessons: Of `LESSONS`.
        build: Folder for data, logs, and what is finished.
        folder: Where weights and card go in the end.
        data: Options of the generator that take the place of the card's own, as more test objects.
    """

    weights: ShippedWeights
    lessons: tuple[str, ...]
    build: Path
    folder: Path = WEIGHTS_FOLDER
    data: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raises: CheckpointError for a lesson that there is not, or an option without a value."""
        if len(self.data) % 2 or not all(word.startswith("--") for word in self.data[::2]):
            raise CheckpointError(f"{shlex.join(self.data)}: options of the generator come with a value each")
        if unknown := sorted(set(self.lessons) - set(LESSONS)):
            raise CheckpointError(f"{', '.join(unknown)}: no such lesson; there are {', '.join(LESSONS)}")

    def run(self, say: Callable[[str], None]) -> WeightsCard:
        """Teach, test, and write weights and card.

        Raises:
            CheckpointError: if the weights have no card.
            StageFailed: if no data can be made.
        """
        card = self._of_its_data(WeightsCard.load(self.weights.file.with_suffix(CARD_SUFFIX)))
        root = self._make_data(card, say)
        of = fingerprint(self.weights.file, card.data["command"])
        done = self._done(of)
        module = load_module(self._taught if done else self.weights.file)
        data = data_of(card, root, module.num_points, scans=self._make_scans(card, say))
        for lesson in (lesson for lesson in LESSONS if lesson in self.lessons and lesson not in done):
            say(f"{self.weights.name}: {lesson} …")
            with shown():
                teach(module, SetClouds(data), (lesson,))
            write_weights(module, self._taught)
            done.append(lesson)
            with atomic_write(self._note) as file:
                file.write(json.dumps({"of": of, "done": done}).encode())
        say(f"{self.weights.name}: test …")
        module = load_module(self._taught)  # as others will read them
        new = self._card(card, tested(module, data, self._place))
        file = self.folder / self.weights.file.name
        self.folder.mkdir(parents=True, exist_ok=True)
        write_weights(module, file)
        new.save(file.with_suffix(CARD_SUFFIX))
        return new

    def _of_its_data(self, card: WeightsCard) -> WeightsCard:
        """The card with the data that are asked for."""
        if not self.data:
            return card
        words = shlex.split(card.data["command"])
        for option, value in zip(self.data[::2], self.data[1::2], strict=True):
            if option in words:
                words[words.index(option) + 1] = value
            else:
                words += [option, value]
        told = {name: int(words[words.index(option) + 1]) for name, option in _TOLD.items() if option in words}
        return replace(card, data=card.data | told | {"command": shlex.join(words)})

    def _make_data(self, card: WeightsCard, say: Callable[[str], None]) -> Path:
        """As the card's command says."""
        name = "-".join(["data", *(word.strip("-") for word in self.data)])  # another set needs another folder
        return self._made("data", card.data["command"], self._place / name, say)

    def _make_scans(self, card: WeightsCard, say: Callable[[str], None]) -> Path | None:
        """The complete clouds that taught views, in the folder of their set; None if none did."""
        if "scans" not in card.data:
            return None
        root = self._made("scans", card.data["scans"], self._place / "scans", say)
        return set_folder(root, card.category, "procedural", "complete", None)

    def _made(self, name: str, command: str, root: Path, say: Callable[[str], None]) -> Path:
        """A folder of data, once it holds what a command of the generator writes."""
        work, words = Workplace(self.weights.name, self._place), shlex.split(command)[1:]  # `python` is this one
        stage = Stage(name, (sys.executable, *words, "--workers", "1", "--out", str(root)))
        if work.seconds(stage) is None:
            work.run(stage, say)
        return root

    def _done(self, of: str) -> list[str]:
        """Lessons that the weights that lie here have had, by this code."""
        note = json.loads(self._note.read_text()) if self._note.is_file() else {}
        return note["done"] if note.get("of") == of else []

    def _card(self, card: WeightsCard, metrics: dict[str, Any]) -> WeightsCard:
        taught = f"{', '.join(lesson for lesson in LESSONS if lesson in self.lessons)} by {commit_of(Path.cwd())}"
        return replace(
            card,
            training=card.training | {"commit": f"{card.training['commit']}; {taught}"},
            metrics={name: metrics[name] for name in card.metrics},
            weaknesses=weaknesses(metrics, card.part_names, card.view),
            date=date.today().isoformat(),
        )

    @property
    def _place(self) -> Path:
        return self.build / self.weights.name

    @property
    def _taught(self) -> Path:
        return self._place / f"taught-{self.weights.file.name}"

    @property
    def _note(self) -> Path:
        return self._place / "lessons.json"
