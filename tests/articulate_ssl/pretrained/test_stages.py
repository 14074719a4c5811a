"""A program that is killed with what started it, or survives it, leaves nothing that cannot be gone on from."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from articulate_ssl.pretrained import stages
from articulate_ssl.pretrained.stages import Stage, StageFailed, Workplace

# Counts its runs in a file, and sleeps in the first.
COUNTING = """
import pathlib, sys, time
file = pathlib.Path(sys.argv[1])
with file.open("a") as out: out.write("x")
time.sleep(float(sys.argv[2]) if len(file.read_text()) == 1 else 0)
"""
STARTER = """
import sys
from pathlib import Path
from articulate_ssl.pretrained.stages import Stage, Workplace
Workplace("it", Path(sys.argv[1])).run(Stage("count", tuple(sys.argv[2:])), print)
"""


def _python(code: str, *words: str) -> tuple[str, ...]:
    return (sys.executable, "-c", code, *words)


def _appears(file: Path) -> None:
    while not file.is_file() or not file.read_text():
        time.sleep(0.01)


def test_a_finished_stage_is_noted_with_its_time_and_its_words(tmp_path):
    work, stage = Workplace("it", tmp_path), Stage("talk", _python("print('words')"))
    assert not work.begun(stage) and work.seconds(stage) is None
    said = []
    work.run(stage, said.append)
    assert work.seconds(stage) > 0 and work.log(stage).read_text() == "words\n"
    assert len(said) == 2 and said[1].startswith("it: talk took")
    assert Workplace("it", tmp_path).seconds(Stage("talk", _python("print('others')"))) is None
    # Another checkout has its own interpreter; the work is the same.
    assert work.seconds(Stage("talk", ("/elsewhere/bin/python", *_python("print('words')")[1:]))) > 0


def test_a_failure_names_the_log(tmp_path):
    stage = Stage("fall", _python("raise SystemExit(3)"))
    with pytest.raises(StageFailed, match=r"it: fall failed with exit code 3; .*fall\.log"):
        Workplace("it", tmp_path).run(stage, print)


def test_time_before_an_interruption_counts_if_the_stage_goes_on(tmp_path, monkeypatch):
    work, stage = Workplace("it", tmp_path), Stage("fit", ("program",))

    def killed(_command, _log, _lock, tick):
        time.sleep(0.05)
        tick()
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "run_program", killed)
    with pytest.raises(KeyboardInterrupt):
        work.run(stage, print)
    assert work.begun(stage) and work.seconds(stage) is None
    monkeypatch.setattr(stages, "run_program", lambda *_: 0)
    work.run(stage, print, ("--ckpt_path", "last.ckpt"))
    assert work.seconds(stage) >= 0.05
    work.run(stage, print)
    assert work.seconds(stage) < 0.05


def test_after_kill_9_of_the_starter_its_program_is_waited_for(tmp_path):
    count = tmp_path / "count"
    command = _python(COUNTING, str(count), "1.0")
    starter = subprocess.Popen(_python(STARTER, str(tmp_path), *command), env={**os.environ, "PYTHONPATH": os.getcwd()})
    _appears(count)
    os.kill(starter.pid, signal.SIGKILL)
    starter.wait()
    work, stage, said = Workplace("it", tmp_path), Stage("count", command), []
    assert work.begun(stage) and work.seconds(stage) is None
    begun = time.monotonic()
    work.run(stage, said.append)
    assert said[0].startswith("it: waiting for the end of another run")
    assert time.monotonic() - begun > 0.3
    assert count.read_text() == "xx" and work.seconds(stage) is not None
