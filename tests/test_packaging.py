"""The installed distribution, the direction of imports, and the commands that documents name."""

from __future__ import annotations

import ast
import importlib
import re
from importlib.metadata import distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# From low to high: a folder of articulate_ssl imports itself and lower ones only (docs/architecture.md).
LAYERS = (
    *("geometry", "ops", "shape", "network", "losses", "discovery", "inference"),
    *("metrics", "baselines", "training", "pretrained", "comparison", "paper_figures", "benchmark", "cli"),
)
# Of articulate_ssl, geometry is everybody's.
FORBIDDEN = {
    "articulate_ssl": {"render"},
    "render": {f"articulate_ssl.{layer}" for layer in LAYERS[1:]},
    "datamodules": {"render", *(f"articulate_ssl.{layer}" for layer in LAYERS[1:])},
    "articulate_ssl/geometry": {"datamodules", "render"},
}


PACKAGES = ("articulate_ssl", "render", "datamodules")


@pytest.mark.parametrize("name", ["torch", "lightning", "trimesh", "pyrender", "open3d", "wandb", "roma", *PACKAGES])
def test_imports(name: str) -> None:
    importlib.import_module(name)


@pytest.mark.parametrize("script", ["lightning", "articulate-ssl"])
def test_one_distribution_owns_the_script(script: str) -> None:
    # A set, because an editable install is listed twice.
    owners = {
        distribution.metadata["Name"]
        for distribution in distributions()
        for entry in distribution.entry_points
        if entry.group == "console_scripts" and entry.name == script
    }
    assert owners == {"articulate-ssl"}


def imported_packages(source: str) -> set[str]:
    """Packages that a module imports, anywhere in it: the first name of a path, and the first two."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {".".join(name.split(".")[:depth]) for name in found for depth in (1, 2)}


def test_imports_inside_functions_are_seen() -> None:
    source = "import a.b.x\ndef f():\n    from c.d import e\n    from c import g\n    from . import h"
    assert imported_packages(source) == {"a", "a.b", "c", "c.d", "c.g"}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_dependencies_point_one_way(package: str) -> None:
    modules = sorted((ROOT / package).rglob("*.py"))
    assert modules
    wrong = {str(path.relative_to(ROOT)): imported_packages(path.read_text()) & FORBIDDEN[package] for path in modules}
    assert {path: packages for path, packages in wrong.items() if packages} == {}


@pytest.mark.parametrize("layer", LAYERS)
def test_no_layer_imports_a_higher_one(layer: str) -> None:
    higher = {f"articulate_ssl.{name}" for name in LAYERS[LAYERS.index(layer) + 1 :]}
    for path in (ROOT / "articulate_ssl" / layer).rglob("*.py"):
        assert imported_packages(path.read_text()) & higher == set(), path


def test_every_module_of_the_method_is_in_a_layer() -> None:
    inside = {path.name for path in (ROOT / "articulate_ssl").iterdir() if path.name != "__pycache__"}
    assert inside == {"__init__.py", *LAYERS}


def test_make_targets_that_documents_name_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    documents = [
        ROOT / "README.md",
        ROOT / ".ci" / "run",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "configs").rglob("*.yaml"),
    ]
    named = {
        (str(path.relative_to(ROOT)), target)
        for path in documents
        # In prose, "make" is a verb: only commands count, at the start of a line or in backquotes.
        for target in re.findall(r"(?:^[ #$]*|`)make ([a-z-]+)", path.read_text(), flags=re.MULTILINE)
    }
    assert (".ci/run", "test") in {(path.replace("\\", "/"), target) for path, target in named}
    assert {(path, target) for path, target in named if target not in targets} == set()
