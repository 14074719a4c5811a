"""Without a renderer the loader is measured all the same."""

from rich.console import Console

from articulate_ssl.benchmark import data_pipeline


def test_a_generator_that_fails_is_reported_and_left_out(monkeypatch, capsys):
    monkeypatch.setattr(data_pipeline, "loader_samples_per_s", lambda: 5.0)
    monkeypatch.setattr(data_pipeline.sys, "executable", "/bin/false")
    (result,) = data_pipeline.data_pipeline(Console())
    assert result.key == "loader_samples_per_s"
    assert "generation not measured" in capsys.readouterr().out
