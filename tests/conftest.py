"""Fixtures that several packages' tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from synthetic import write_synthetic_set


@pytest.fixture
def synthetic_set(tmp_path: Path) -> Path:
    """Folder of a fresh, small data set of the complete view; its root is `tmp_path`, its category `laptop`."""
    return write_synthetic_set(tmp_path)
