"""The installed distribution, the direction of imports, and the commands that documents name."""

from __future__ import annotations

import ast
import importlib
import re
from importlib.metadata import distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {
    "articulate_ssl": {"render"},
    "render": {"articulate_ssl"},
    "datamodules": {"articulate_ssl", "render"},
}


@pytest.mark.parametrize("name", ["torch", "lightning", "trimesh", "pyrender", "open3d", "wandb", "roma", *FORBIDDEN])
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
    """Top-level packages that a module imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def test_imports_inside_functions_are_seen() -> None:
    assert imported_packages("import a.b\ndef f():\n    from c.d import e\n    from . import g") == {"a", "c"}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_dependencies_point_one_way(package: str) -> None:
    modules = sorted((ROOT / package).rglob("*.py"))
    assert modules
    wrong = {str(path.relative_to(ROOT)): imported_packages(path.read_text()) & FORBIDDEN[package] for path in modules}
    assert {path: packages for path, packages in wrong.items() if packages} == {}


def test_make_targets_that_documents_name_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
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
        for target in re.findall(r"(?:^[ #$]*|`)make ([a-z]+)", path.read_text(), flags=re.MULTILINE)
    }
    assert (".ci/run", "test") in {(path.replace("\\", "/"), target) for path, target in named}
    assert {(path, target) for path, target in named if target not in targets} == set()
