"""The table that `make bench` prints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from rich.console import Console
from rich.table import Table

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.result import Result


def print_table(console: Console, machine: Machine, results: Sequence[Result]) -> None:
    """Median and spread of every result."""
    title = f"{machine.name}, {machine.precision}, torch {torch.__version__}"
    table = Table("", "median", "lowest", "highest", "runs", title=title)
    for result in results:
        numbers = [f"{v:.3g} {result.unit}" for v in (result.median, min(result.values), max(result.values))]
        table.add_row(result.label, *numbers, str(len(result.values)))
    console.print(table)
