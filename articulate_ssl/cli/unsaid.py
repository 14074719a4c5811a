"""What `lightning fit|validate|test` does where the command line does not say.

Without an accelerator, the `cpu` profile applies: paper size would take days. It goes behind the first `-c`, the
category, so that every profile and option that was typed behind that wins. Who names `trainer.accelerator`, in a file
or as an option, has thought of the machine: then nothing is added.

Without `-c`, `validate` and `test` take the configuration that `lightning fit` saved beside the newest checkpoint, or
beside the one that was named.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from lightning.pytorch.accelerators import CUDAAccelerator, MPSAccelerator, XLAAccelerator

from articulate_ssl.inference.checkpoint_file import CheckpointError

# The same file as configs/profiles/cpu.yaml, here so that it is installed with the package.
CPU_PROFILE = Path(__file__).with_name("cpu_profile.yaml")
RUNS = Path("runs")  # what the default_root_dir of every category's configuration lies in
_COMMANDS = ("fit", "validate", "test")


class Completed(NamedTuple):
    """A command line with what was added to it.

    Attributes:
        words: Of the command line.
        notes: What was added and how to overrule it, one line each.
    """

    words: list[str]
    notes: list[str]


def completed(words: list[str]) -> Completed:
    """The command line, completed.

    Raises:
        CheckpointError: where a run is to be looked up and there is none.
    """
    if not words or words[0] not in _COMMANDS or {"-h", "--help"} & set(words):
        return Completed(words, [])
    notes = []
    if words[0] != "fit" and not _configs(words) and given_option(words, "--data.category") is None:
        words, note = _with_run(words)
        notes.append(note)
    if not _accelerator_named(words) and not accelerator_available():
        first = _configs(words)[0][1] if _configs(words) else 0
        words = [*words[: first + 1], "-c", str(CPU_PROFILE), *words[first + 1 :]]
        notes.append(
            "no GPU here, so configs/profiles/cpu.yaml applies (a small network, fewer steps); "
            "-c configs/profiles/paper.yaml keeps the sizes of the category's file"
        )
    return Completed(words, notes)


def accelerator_available() -> bool:
    """Whether there is anything that `--trainer.accelerator auto` would prefer to the CPU."""
    return any(kind.is_available() for kind in (CUDAAccelerator, MPSAccelerator, XLAAccelerator))


def newest_checkpoint(folder: Path) -> Path | None:
    """The checkpoint under a folder that was written last, if there is one."""
    return max(folder.glob("**/checkpoints/*.ckpt"), key=lambda path: path.stat().st_mtime, default=None)


def given_option(words: list[str], name: str) -> str | None:
    """What the command line says last about an option, written in either way; None if nothing."""
    said = [after for word, after in pairwise(words) if word == name]
    said += [word.partition("=")[2] for word in words if word.startswith(f"{name}=")]
    return said[-1] if said else None


def _with_run(words: list[str]) -> tuple[list[str], str]:
    """The command with configuration and checkpoint of a run, and which."""
    given = given_option(words, "--ckpt_path")
    root = Path(given_option(words, "--trainer.default_root_dir") or RUNS)
    checkpoint = newest_checkpoint(root) if given is None else Path(given)
    if checkpoint is None:
        raise CheckpointError(
            f"no checkpoint under {root}; run `lightning fit -c configs/<category>.yaml` first, or name a run "
            "with -c and --ckpt_path"
        )
    config = checkpoint.parent.parent / "config.yaml"
    if not config.is_file():
        raise CheckpointError(
            f"{checkpoint}: no configuration of its run in {config.parent}; give the -c files of its `lightning fit`"
        )
    # In front of what was typed, which wins; the checkpoint because the saved configuration may name an older one.
    added = ["-c", str(config), *([] if given else ["--ckpt_path", str(checkpoint)])]
    newest = "the run of that checkpoint" if given else f"the newest run, checkpoint {checkpoint.name}"
    return [words[0], *added, *words[1:]], f"no -c given: takes {newest}, with {config}"


def _configs(words: list[str]) -> list[tuple[str, int]]:
    """Configuration files of a command line, in order, each with the index of the word that names it."""
    found = []
    for i, word in enumerate(words):
        if word.startswith("--config="):
            found.append((word.partition("=")[2], i))
        elif word in ("-c", "--config") and i + 1 < len(words):
            found.append((words[i + 1], i + 1))
        elif word.startswith("-c") and word != "-c":  # as one word, `-c=FILE` or `-cFILE`
            found.append((word[2:].removeprefix("="), i))
    return found


def _accelerator_named(words: list[str]) -> bool:
    trainers = [_content(Path(path)).get("trainer") for path, _ in _configs(words)]
    named = any(isinstance(trainer, dict) and "accelerator" in trainer for trainer in trainers)
    return named or given_option(words, "--trainer.accelerator") is not None


def _content(path: Path) -> dict[str, Any]:
    """Of a configuration file; nothing where there is no file, which the parser will refuse with better words.

    Raises:
        ValueError: if it holds no options: the parser would not say which of several files it is.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError:
        return {}
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not YAML ({' '.join(str(error).split())}); mend it, or name another file") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: no configuration, which has lines as `data:` and `model:`; name another file")
    return content
