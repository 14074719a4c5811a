"""The journal of a set that is being made: which shards are finished, so that an interrupted run can be continued."""

from __future__ import annotations

import importlib.metadata
import json
from dataclasses import asdict
from pathlib import Path

from datamodules.atomic import atomic_write
from render.shard_task import ShardResult

JOURNAL_NAME = ".journal.jsonl"


class Journal:
    """The finished shards of a set that is being made: one JSON line for the options, one for every shard."""

    def __init__(self, path: Path, recorded: dict) -> None:
        """Open or start a journal.

        Args:
            path: Of the journal.
            recorded: Options of the set, as its manifest records them.

        Raises:
            ValueError: if another set was begun in this folder.
        """
        self.path = path
        lines = self._lines() or [described(recorded)]
        require_same_options(lines[0], described(recorded), path.parent)
        with atomic_write(path) as file:  # without a line that a killed run left unfinished
            file.writelines(json.dumps(line).encode() + b"\n" for line in lines)

    def append(self, result: ShardResult) -> None:
        """Note a finished shard."""
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(result)) + "\n")

    def read(self) -> dict[tuple[str, str], ShardResult]:
        """Finished shards by split and name."""
        results = [ShardResult(**{key: _tuples(value) for key, value in line.items()}) for line in self._lines()[1:]]
        return {(result.split, result.name): result for result in results}

    def _lines(self) -> list[dict]:
        """All complete lines."""
        if not self.path.exists():
            return []
        lines = []
        for text in self.path.read_text(encoding="utf-8").splitlines():
            try:
                lines.append(json.loads(text))
            except json.JSONDecodeError:
                continue
        return lines


def _tuples(value):
    """JSON lists back as the tuples they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def described(recorded: dict) -> dict:
    """The options as they come back from a JSON file."""
    return json.loads(json.dumps({"generator_version": generator_version(), **recorded}))


def generator_version() -> str:
    """Version of the installed package."""
    return importlib.metadata.version("articulate-ssl")


def require_same_options(found: dict, wanted: dict, folder: Path) -> None:
    """Raise ValueError, naming the differences, if a folder's set was made with other options."""
    different = [f"{key} {found.get(key)!r}, now {value!r}" for key, value in wanted.items() if found.get(key) != value]
    if different:
        raise ValueError(
            f"{folder} holds a set made with other options ({'; '.join(different)}); delete that folder, pass another "
            f"--out, or repeat the options"
        )
