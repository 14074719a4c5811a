"""A result is of weights, options and code; if one of them changes, it is another."""

from types import SimpleNamespace

import pytest

from articulate_ssl.pretrained import fingerprint as module
from articulate_ssl.pretrained.fingerprint import fingerprint


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A file of weights, beside a package with one source file."""
    code = tmp_path / "package" / "__init__.py"
    code.parent.mkdir()
    code.write_text("one")
    monkeypatch.setattr(module, "articulate_ssl", SimpleNamespace(__file__=str(code)))
    module._code.cache_clear()
    yield tmp_path / "some.safetensors"
    module._code.cache_clear()


def test_it_changes_with_weights_options_and_code(weights):
    weights.write_bytes(b"a")
    first = fingerprint(weights, 160)
    assert fingerprint(weights, 160) == first
    assert fingerprint(weights, 161) != first
    weights.write_bytes(b"b")
    second = fingerprint(weights, 160)
    assert second != first
    (weights.parent / "package" / "other.py").write_text("two")
    module._code.cache_clear()
    assert fingerprint(weights, 160) != second
    (weights.parent / "package" / "some.json").write_text("{}")
    third = fingerprint(weights, 160)
    module._code.cache_clear()
    assert fingerprint(weights, 160) == third  # not code
