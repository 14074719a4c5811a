"""`articulate-ssl view FOLDER`: a prediction in the browser, with a slider for every joint.

Only programs on this machine reach it. From another one, forward the port: `ssh -L 8080:localhost:8080 MACHINE`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console

from articulate_ssl.cli import BAD_INPUT

DEFAULT_PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("folder", type=Path, help="folder of results that `articulate-ssl predict` wrote")
    parser.add_argument(
        "--port", type=_port, default=DEFAULT_PORT, help=f"default: {DEFAULT_PORT}, or the next one that is free"
    )


def run(arguments: list[str]) -> int:
    """Serve the prediction, print where, and go on until Ctrl-C.

    Returns:
        Exit code: 0, or 2 for a folder without a prediction, with one message on stderr.

    Raises:
        SystemExit: of code 2 for bad arguments, with the usage on stderr; of code 0 for --help.
    """
    parser = argparse.ArgumentParser(
        prog="articulate-ssl view", description="Look at a prediction in the browser and move its joints."
    )
    add_arguments(parser)
    args = parser.parse_args(arguments[1:])
    with Console(stderr=True).status("opening the prediction"):
        from articulate_ssl.inference.export.arrays import ResultFolderError, load_scan_prediction
        from articulate_ssl.inference.viewer.live import LiveViewer

        try:
            viewer = LiveViewer(load_scan_prediction(args.folder), args.port)
        except (ResultFolderError, OSError) as error:
            print(f"articulate-ssl view: {error}", file=sys.stderr)
            return BAD_INPUT
    with viewer:
        print(f"{args.folder} at {viewer.url} (Ctrl-C ends it)", flush=True)
        try:
            viewer.wait()
        except KeyboardInterrupt:
            print()
    return 0


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port; use a number up to 65535")
    return int(text)
