"""The command line: `lightning fit|validate|test -c configs/<category>.yaml`, `articulate-ssl predict CLOUD …`, …

Both console scripts, `lightning` and `articulate-ssl`, are this program. A command is a module of this folder that
offers `run(arguments: list[str]) -> int`: it takes all words of the command line, its own name first, and returns the
exit code. `COMMANDS` names it. Modules are imported only to run them, and import PyTorch only once their arguments are
understood: that takes seconds, and help should not.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NamedTuple

from articulate_ssl.ops.idle_threads import sleep_soon

BAD_INPUT = 2  # the exit code


class Command(NamedTuple):
    """What a word of the command line stands for.

    Attributes:
        module: Which offers `run`.
        help: One line about it.
    """

    module: str
    help: str


_LEARN = "articulate_ssl.cli.learn"
COMMANDS = {
    "predict": Command("articulate_ssl.cli.predict", "one scan: parts, poses, joints, URDF and a picture"),
    "twin": Command("articulate_ssl.cli.twin", "eight or more scans of one object: its parts and joints, untrained"),
    "view": Command("articulate_ssl.cli.view", "a prediction in the browser, with a slider for every joint"),
    "weights": Command("articulate_ssl.cli.weights", "in the package: list, show, test on objects of yours, make anew"),
    "fit": Command(_LEARN, "train on a data set that `make data` made, without labels"),
    "validate": Command(_LEARN, "reconstruction error on training clouds that were held out"),
    "test": Command(_LEARN, "score the newest run, or another, on objects that training never saw"),
}
_HELP = """usage: articulate-ssl COMMAND …

Understand articulated objects from point clouds, without a label.

commands (articulate-ssl COMMAND --help says more):
{commands}

examples:
  articulate-ssl predict scan.ply --category laptop
  articulate-ssl fit -c configs/oven.yaml && articulate-ssl test

`lightning` is the same program."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code: 0, or 2 for bad arguments or bad input (one message, no traceback)."""
    sleep_soon()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = (f"  {word:{width}}  {command.help}" for word, command in COMMANDS.items())
        print(_HELP.format(commands="\n".join(lines)))
        return 0
    # Options before the command are for Lightning's own parser.
    module = COMMANDS[first].module if first in COMMANDS else _LEARN if first.startswith("-") else None
    if module is None:
        problem = f"{first!r} is no command" if first else "a command is missing"
        print(f"articulate-ssl: {problem}; there are {', '.join(COMMANDS)}", file=sys.stderr)
        return BAD_INPUT
    return import_module(module).run(arguments)
