"""What a result was measured of: weights, options, and the code that measured.

What was finished before stays valid as long as none of them has changed.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import articulate_ssl
import datamodules


def fingerprint(weights: Path, *options: object) -> str:
    """Of a file of weights, what else a result depends on, and all Python code that learns and measures."""
    digest = hashlib.sha256(weights.read_bytes())
    digest.update(repr(options).encode())
    digest.update(_code())
    return digest.hexdigest()


@cache
def _code() -> bytes:
    digest = hashlib.sha256()
    for package in (articulate_ssl, datamodules):
        root = Path(package.__file__).parent
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.digest()
