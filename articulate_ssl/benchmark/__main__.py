"""`make bench`: how fast the fast operators are against their readable twins, and how cost grows.

Every ratio is measured in one run, twin and fast operator in turn, so that load on the machine hits both. The twins are
those of `ops.reference`; they compute as the original implementation does, with correlation weights for every
neighbour, kernel point and group element. Needs neither a renderer nor a data set; runs on any device that PyTorch
knows:

    python -m articulate_ssl.benchmark --device cuda
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.console import Console

from articulate_ssl.benchmark.data_pipeline import data_pipeline
from articulate_ssl.benchmark.growth import exponent, growth, plot_growth
from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.operators import operators
from articulate_ssl.benchmark.result import Result
from articulate_ssl.benchmark.table import print_table
from articulate_ssl.benchmark.whole_network import whole_network
from articulate_ssl.ops.denormals import flush_denormals


@flush_denormals()  # as the command line does
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print one table, write bench.json and the plot."""
    options = _parse(arguments)
    machine = Machine(options.device, options.precision or ("bf16" if options.device.startswith("cuda") else "32"))
    console = Console(width=110)
    options.output.mkdir(parents=True, exist_ok=True)
    results: list[Result] = []

    def keep(more: Sequence[Result]) -> None:
        # Written after every part: a later part that fails loses nothing.
        results.extend(more)
        numbers = {result.key: result.median for result in results if result.key}
        (options.output / "bench.json").write_text(json.dumps(numbers | {"device": machine.name}, indent=2) + "\n")

    keep(operators(machine))
    measured = growth(machine)
    for path in filter(None, (options.output / "bench.png", options.plot)):
        plot_growth(measured, path)
    for name, (sizes, seconds, memory) in measured.items():
        keep([Result(f"exponent_{name}", f"growth of time with {name}, exponent", [exponent(sizes, seconds)])])
        keep([Result(None, "  growth of memory", [exponent(sizes, memory)])])
    keep(data_pipeline(console))
    keep(whole_network(machine))
    print_table(console, machine, results)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m articulate_ssl.benchmark", description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--precision", choices=("32", "bf16"), help="default: bf16 on a GPU, 32 on a CPU")
    parser.add_argument("--output", type=Path, default=Path("build"), help="folder of bench.json and bench.png")
    parser.add_argument("--plot", type=Path, help="a second place for the plot, for the documentation")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
