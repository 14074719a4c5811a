"""`make` lists its targets and passes options on."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run make without what an outer make, or the shell, would pass down to it."""
    environment = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    return subprocess.run(["make", *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def commands(*arguments: str) -> str:
    """What make would run."""
    done = make("-n", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_help_is_the_default_and_lists_every_target() -> None:
    phony = re.search(r"^\.PHONY: (.*)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    listed = re.findall(r"^  make ([\w-]+) +\S", make().stdout, flags=re.MULTILINE)
    assert sorted(listed) == sorted(phony)


def test_data_by_default() -> None:
    words = commands("data", "CAT=laptop").split()
    assert "render.generate" in words
    for option, value in {
        "--category": "laptop",
        "--view": "complete",
        "--source": "procedural",
        "--out": "data",
    }.items():
        assert words[words.index(option) + 1].strip("'") == value
    assert not {"--root", "--workers", "--protocol"} & set(words)


def test_data_passes_every_option() -> None:
    text = commands(
        "data", "CAT=oven", "VIEW=partial", "SOURCE=urdf", "ROOT=/my objects", "OUT=/sets", "WORKERS=3", "SEED=7",
        "PROTOCOL=eap", "ARGS=--states 5 --noise-std 0.01",
    )  # fmt: skip
    for option in (
        "--category 'oven'", "--view 'partial'", "--source 'urdf'", "--root '/my objects'", "--out '/sets'",
        "--workers '3'", "--seed '7'", "--protocol 'eap'", "--states 5 --noise-std 0.01",
    ):  # fmt: skip
        assert option in text


def test_compare_passes_every_option() -> None:
    assert "--build" not in commands("compare", "CAT=laptop")
    text = commands(
        "compare", "CAT=all", "VIEW=partial", "SEEDS=3", "METHODS=npcs_epn staged", "ROOT=/sets", "OUT=/tables",
        "WORKERS=2", "ARGS=--samples 20",
    )  # fmt: skip
    for option in (
        "--categories all", "--view 'partial'", "--seeds '3'", "--methods npcs_epn staged", "--root '/sets'",
        "--build '/tables'", "--workers '2'", "--samples 20",
    ):  # fmt: skip
        assert option in text


@pytest.mark.parametrize("target", ["data", "preview", "compare"])
def test_category_is_demanded_before_anything_runs(target: str) -> None:
    done = make(target)
    assert done.returncode == 2
    assert f"make {target} CAT=laptop" in done.stderr or "make data CAT=laptop" in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "compiled"),
    [
        (("setup",), True),
        (("setup", "CLUSTER=0"), False),
        (("test",), False),
        (("demo",), False),
        (("test", "CLUSTER=1"), True),
    ],
)
def test_only_setup_compiles_extensions_unasked(arguments: tuple[str, ...], compiled: bool) -> None:
    # -B: as on a machine where nothing is set up.
    assert (".ci/setup cluster" in commands("-B", *arguments)) == compiled


def test_scripts_are_executable_and_sound_bash() -> None:
    for script in ("run", "setup"):
        path = ROOT / ".ci" / script
        assert os.access(path, os.X_OK)
        subprocess.run(["bash", "-n", str(path)], check=True)
        assert "set -euo pipefail" in path.read_text()
