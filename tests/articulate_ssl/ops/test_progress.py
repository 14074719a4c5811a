"""Announced work is shown in lines or on a rich display, and nobody who works knows who listens."""

import io
import logging

import pytest
from rich.console import Console
from rich.progress import Progress

from articulate_ssl.ops import progress
from articulate_ssl.ops.progress import Listener, Stage, announce, announced, listening, tell

log = logging.getLogger("articulate_ssl.toy")


@pytest.fixture
def display():
    with Progress(console=Console(file=io.StringIO(), force_terminal=True), auto_refresh=False) as display:
        yield display


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when told to."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_without_a_listener_nothing_is_said(capfd):
    assert list(announced(log, "toys", [1, 2])) == [1, 2]
    assert capfd.readouterr() == ("", "")


def test_without_a_display_there_are_lines_but_not_too_many(clock, capsys):
    with listening(Listener(lambda: None)):
        for _ in announced(log, "toys", range(40)):
            clock[0] += 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "toys, 0 of 40 done after 0:00:00"
    assert lines[2] == "toys, 20 of 40 done after 0:00:20"
    assert lines[-1] == "toys: took 0:00:40" and len(lines) == 5


def test_on_a_display_there_is_a_bar_with_details_until_the_work_is_done(display, capsys):
    with listening(Listener(lambda: display)):
        announce(log, Stage("toys", "first half", 0, 2))
        announce(log, Stage("toys", "second half", 1, 2))
        log.info("painting %d", 7)
        (task,) = display.tasks
        assert (task.completed, task.total, task.description) == (1, 2, "toys: second half, painting 7")
        announce(log, Stage("toys", "", 2, 2))
        assert display.tasks == []
    assert capsys.readouterr().err == "toys: took 0:00:00\n"


def test_work_that_fails_is_taken_from_the_display(display):
    with pytest.raises(KeyError), listening(Listener(lambda: display)):
        announce(log, Stage("toys", "first half", 0, 2))
        raise KeyError
    assert display.tasks == []


def test_warnings_are_written_and_other_messages_only_beside_work(capsys):
    with listening(Listener(lambda: None)):
        log.info("whatever")
        log.warning("a wheel came off")
    assert capsys.readouterr().err == "a wheel came off\n"


def test_what_was_found_is_written_whenever_it_is_told(display, capsys):
    with listening(Listener(lambda: None)):
        tell(log, "%d toys", 3)
    with listening(Listener(lambda: display)):
        announce(log, Stage("toys", "first half", 0, 2))
        tell(log, "%d more", 4)
        assert display.tasks[0].description == "toys: first half"
    assert capsys.readouterr().err == "3 toys\n4 more\n"


def test_logging_is_left_as_it_was():
    logger = logging.getLogger("articulate_ssl")
    before = logger.level, list(logger.handlers)
    with listening(Listener(lambda: None)):
        assert logger.isEnabledFor(logging.INFO)
    assert (logger.level, logger.handlers) == before
