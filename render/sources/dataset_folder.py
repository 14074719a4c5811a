"""What the sources share: finding one folder per instance, or all files, and reading JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

_DEPTH = 5  # of folders that are searched; symbolic links may lead round in circles


def find_instances(
    root: Path | None,
    marker: str,
    category_folders: Iterable[str] = (),
    prefixes: Iterable[str] = (".",),
) -> dict[str, Path]:
    """Instance folders by id, sorted; an instance folder is one that holds the file `marker`.

    `root` may be an instance folder itself, the folder of a category, or a folder above. The id is the path below the
    category's folder (below `root` if there is none), for one instance alone its folder's name. Hidden folders are not
    looked into.

    Args:
        root: Where to look.
        marker: Name of a file that every instance has.
        category_folders: Names that the data set's folder of the category may have.
        prefixes: Folders below `root` in which it may lie.

    Raises:
        ValueError: if there is no instance.
    """
    if root is None or not Path(root).is_dir():
        raise ValueError(f"{root or 'no root given'}: not a folder; --root must name the folder of the data set")
    root = Path(root)
    if (root / marker).is_file():
        return {root.resolve().name: root}
    named = [root / prefix / name for prefix in prefixes for name in category_folders]
    base = next((folder for folder in named if folder.is_dir()), root)
    found = {path.relative_to(base).as_posix(): path for path in _folders_with(marker, base, depth=_DEPTH)}
    if not found:
        raise ValueError(f"{base}: no instance found, no folder in it holds a {marker}")
    return found


def _folders_with(marker: str, folder: Path, depth: int) -> Iterator[Path]:
    """Folders below `folder` that hold the marker, sorted; instances are not searched for further instances."""
    if depth == 0:
        return
    for below in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        if (below / marker).is_file():
            yield below
        else:
            yield from _folders_with(marker, below, depth - 1)


def files_below(folder: Path, above: frozenset[Path] | None = None) -> Iterator[Path]:
    """All files below a folder but hidden ones and those in hidden folders, sorted; symbolic links are followed.

    Args:
        folder: Where to look.
        above: Folders that are not entered again, as a link may lead back to one: those on the way to `folder`.

    Raises:
        OSError: if a folder cannot be read.
    """
    place = folder.resolve()
    above = frozenset(place.parents) if above is None else above
    if place in above:
        return
    for path in sorted(path for path in folder.iterdir() if not path.name.startswith(".")):
        if path.is_dir():
            yield from files_below(path, above | {place})
        elif path.is_file():
            yield path


def read_json(file: Path) -> Any:
    """Content of a JSON file.

    Raises:
        ValueError: naming the file, if it is missing or malformed.
    """
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{file}: missing or unreadable ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not valid JSON ({error})") from error
