"""Speed of data generation and of the training loader."""

from __future__ import annotations

import json
import subprocess
import sys

from rich.console import Console

from articulate_ssl.benchmark.result import Result
from datamodules.benchmark import loader_samples_per_s

# A program of its own: the method does not import the renderer, and runs where there is none.
GENERATION = """
import json
from render.benchmark import complete_clouds_per_s, partial_frames_per_s
print(json.dumps({f.__name__: f() for f in (partial_frames_per_s, complete_clouds_per_s)}))
"""


def data_pipeline(console: Console) -> list[Result]:
    """Speed of generation (a separate program) and of the training loader."""
    loader = Result("loader_samples_per_s", "training loader", [loader_samples_per_s()], "/s")
    finished = subprocess.run([sys.executable, "-c", GENERATION], capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        reason = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        console.print(f"generation not measured, the renderer does not run here: {reason}", style="yellow")
        return [loader]
    rendered = json.loads(finished.stdout.strip().splitlines()[-1])
    return [loader, *(Result(key, key.replace("_", " "), [value]) for key, value in rendered.items())]
