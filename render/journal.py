"""The journal of a set that is being made: what it is made of, and which shards are finished, so that it can go on."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path

from datamodules.atomic import atomic_write
from datamodules.manifest import SPLITS
from render.shard_task import ShardResult

JOURNAL_NAME = ".journal.jsonl"
_LEFT_OUT = "left out"
_NAMED = 5  # objects or scans, in a list of many

Contents = dict[str, dict[str, str]]  # `places` and `checksums` by name, see `contents_of`


class Journal:
    """The finished shards of a set that is being made: one JSON line for the set, one for every shard.

    A line that cannot be read is as if it were not there: its shard is made again.
    """

    def __init__(self, path: Path, wanted: dict) -> None:
        """Open or start a journal.

        Args:
            path: Of the journal.
            wanted: What the set is, see `described`.

        Raises:
            ValueError: if another set was begun in this folder, or the journal does not say which.
        """
        self.path = path
        lines = self._lines() or [wanted]
        if "generator_version" not in lines[0]:
            raise ValueError(
                f"{path}: is damaged, its first line does not say what set was begun; delete it and repeat the "
                "command: all shards are made again"
            )
        require_same(lines[0], wanted, path.parent)
        with atomic_write(path) as file:  # without a line that a killed run left unfinished
            file.writelines(json.dumps(line).encode() + b"\n" for line in lines)

    def append(self, result: ShardResult) -> None:
        """Note a finished shard."""
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(result)) + "\n")

    def read(self) -> dict[tuple[str, str], ShardResult]:
        """Finished shards by split and name."""
        results = {}
        for line in self._lines()[1:]:
            try:
                result = ShardResult(**{key: _tuples(value) for key, value in line.items()})
            except TypeError:
                continue
            results[result.split, result.name] = result
        return results

    def _lines(self) -> list[dict]:
        """All complete lines."""
        if not self.path.exists():
            return []
        lines = []
        for text in self.path.read_bytes().splitlines():
            try:
                lines.append(json.loads(text))
            except ValueError:
                continue
        return [line for line in lines if isinstance(line, dict)]


def _tuples(value):
    """JSON lists back as the tuples they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def described(recorded: dict, contents: Contents) -> dict:
    """What a set is, as it comes back from a JSON file: its options, as the manifest records them, and its contents."""
    return json.loads(json.dumps({"generator_version": generator_version(), **recorded, "contents": contents}))


def contents_of(splits: Mapping[str, Iterable[str]], left_out: Iterable[str], checksums: Mapping[str, str]) -> Contents:
    """What a set is made of: where each of its objects, or scans, is, and the checksums that are known of them."""
    places = {name: split for split in SPLITS for name in splits[split]}
    return {"places": dict.fromkeys(left_out, _LEFT_OUT) | places, "checksums": dict(checksums)}


def generator_version() -> str:
    """Version of the installed package."""
    return importlib.metadata.version("articulate-ssl")


def require_same(found: dict, wanted: dict, folder: Path) -> None:
    """Raise ValueError, naming the differences, if a folder's set is another one; see `described`.

    Contents that an older version did not record are not compared.
    """
    options = {key: value for key, value in wanted.items() if key != "contents"}
    different = [
        f"{key} {found.get(key)!r}, now {value!r}" for key, value in options.items() if found.get(key) != value
    ]
    if "contents" in found:
        different += _differences(found["contents"], wanted["contents"])
    if different:
        raise ValueError(
            f"{folder} holds a set made with other options or of other files ({'; '.join(different)}); delete that "
            "folder, pass another --out, or repeat the options with those files"
        )


def _differences(found: Contents, wanted: Contents) -> list[str]:
    """How contents differ, in words."""
    checksums = found["checksums"]
    # A set of external files without checksums is of an older version, and not all of these noted what was left out.
    before, now = (
        {name: place for name, place in contents["places"].items() if checksums or place != _LEFT_OUT}
        for contents in (found, wanted)
    )
    kinds = {
        "added": [name for name in now if name not in before],
        "removed": [name for name in before if name not in now],
        "now in another split": [name for name in now if before.get(name, now[name]) != now[name]],
        "changed": [
            name for name, checksum in wanted["checksums"].items() if checksums.get(name, checksum) != checksum
        ],
    }
    return [f"{kind}: {_some(names)}" for kind, names in kinds.items() if names]


def _some(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
