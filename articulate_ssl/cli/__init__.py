"""The command line: `lightning fit|validate|test -c configs/<category>.yaml`, `lightning predict CLOUD --category …`, …

Both console scripts, `lightning` and `articulate-ssl`, are this program. A command is a module of this folder that
offers `run(arguments: list[str]) -> int`: it takes all words of the command line, its own name first, and returns the
exit code. `COMMANDS` names it.
"""

from __future__ import annotations

import sys
from importlib import import_module

from articulate_ssl.ops.idle_threads import sleep_soon

BAD_INPUT = 2  # the exit code
# Modules are imported only to run them, because the training code takes long to import.
COMMANDS = {
    "predict": "articulate_ssl.cli.predict",
    "twin": "articulate_ssl.cli.twin",
    "view": "articulate_ssl.cli.view",
    "weights": "articulate_ssl.cli.weights",
}
# Lightning's own parser knows fit, validate, test and --help, and refuses what nobody knows.
OTHERWISE = "articulate_ssl.cli.learn"


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code: 0, or 2 for bad arguments or bad input (one message, no traceback)."""
    sleep_soon()
    from articulate_ssl.ops.denormals import flush_denormals

    arguments = sys.argv[1:] if arguments is None else list(arguments)
    module = COMMANDS.get(arguments[0], OTHERWISE) if arguments else OTHERWISE
    with flush_denormals():
        return import_module(module).run(arguments)
