"""`docs/laptop.ipynb` runs from top to bottom, in a quick version, and is stored without what it said."""

from __future__ import annotations

import json
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from articulate_ssl.inference.export.arrays import load_scan_prediction

NOTEBOOK = Path(__file__).parents[2] / "docs" / "laptop.ipynb"
SECONDS = 600  # of one cell; the longest takes twenty on a quiet core


@pytest.fixture(scope="module")
def notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def code(notebook) -> list:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_no_output_is_stored(notebook) -> None:
    nbformat.validate(notebook)
    assert code(notebook)
    assert not [cell for cell in code(notebook) if cell.outputs or cell.execution_count is not None]


@pytest.mark.timeout(900)  # a process for every command, each of which imports torch
def test_it_runs_and_shows_what_it_says(notebook, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ARTICULATE_SSL_QUICK", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # or pictures would not be shown
    done = NotebookClient(
        nbformat.from_dict(notebook), timeout=SECONDS, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()

    shown = [output for cell in code(done) for output in cell.outputs if "data" in output]
    assert sum("image/png" in output.data for output in shown) == 4
    text = "\n".join(output.data.get("text/plain", "") for output in shown)
    assert text.count("revolute") >= 2
    (out,) = tmp_path.glob("laptop-*")
    for folder in ("prediction", "twin"):
        assert (out / folder / "object.urdf").is_file()
        assert len(load_scan_prediction(out / folder).joints) == 1
    assert (out / "prediction" / "view.html").is_file()
    states = json.loads((out / "twin" / "states.json").read_text())
    assert list(states) == sorted(file.name for file in (out / "scans").iterdir())
