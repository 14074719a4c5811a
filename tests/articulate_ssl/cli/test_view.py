import re
import urllib.request

import pytest
import synthetic_predictions as synthetic
from scan_predictions import result_of

from articulate_ssl.cli.view import run
from articulate_ssl.inference.export import arrays
from articulate_ssl.inference.viewer.live import LiveViewer


@pytest.fixture
def results(tmp_path):
    arrays.write(result_of(synthetic.laptop), tmp_path)
    return tmp_path


def test_the_folder_is_served_where_the_command_says_until_it_is_interrupted(results, monkeypatch, capsys):
    pages, said = [], []

    def interrupted(viewer) -> None:
        said.append(capsys.readouterr().out)
        pages.append(urllib.request.urlopen(re.search(r"http://\S+", said[0])[0]).read(2000))
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveViewer, "wait", interrupted)
    assert run(["view", str(results), "--port", "0"]) == 0
    assert b"<html" in pages[0]
    assert str(results) in said[0] and "Ctrl-C" in said[0]
    with pytest.raises(OSError):
        urllib.request.urlopen(re.search(r"http://\S+", said[0])[0], timeout=5)


def test_a_folder_without_a_prediction_exits_2_with_one_message(tmp_path, capsys):
    assert run(["view", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(tmp_path) in captured.err and "articulate-ssl predict" in captured.err
    assert "Traceback" not in captured.err


@pytest.mark.parametrize("port", ["http", "-1", "65536"])
def test_what_is_no_port_is_refused(results, capsys, port):
    with pytest.raises(SystemExit) as stop:
        run(["view", str(results), f"--port={port}"])
    assert stop.value.code == 2
    assert port in capsys.readouterr().err
