"""`articulate-ssl weights …` as it is typed."""

import json
import shutil

import pytest
from packable import ROOT, made_up_metrics, write_run

from articulate_ssl.cli import main
from articulate_ssl.pretrained import ablation, check, rebuild
from articulate_ssl.training import shipped_weights


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def package(tmp_path, monkeypatch, run_folder):
    """A package into which a run was packed by the command."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", tmp_path / "weights")
    words = ["weights", "pack", str(run_folder), "--commit", "abc", "--folder", str(tmp_path / "weights")]
    assert main(words) == 0
    return tmp_path / "weights"


def test_packed_weights_are_listed_and_shown(package, capsys):
    assert main(["weights", "list"]) == 0
    assert "laptop-complete" in capsys.readouterr().out
    assert main(["weights", "show", "laptop"]) == 0
    out = capsys.readouterr().out
    assert "# laptop, complete clouds" in out and "commit abc" in out


def test_a_list_names_what_was_trained_in_another_setting(package, capsys):
    card = package / "laptop-complete.json"
    card.write_text(json.dumps(json.loads(card.read_text()) | {"setting": "multi-state"}))
    assert main(["weights", "list"]) == 0
    assert "multi-state (training knew which clouds show the same object): laptop-complete" in capsys.readouterr().out


def test_unknown_weights_exit_2_with_one_line(package, capsys):
    assert main(["weights", "show", "toaster"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "toaster: no such weights" in err and "laptop-complete" in err


def test_a_run_that_was_not_tested_exits_2(package, tmp_path, capsys, run_folder):
    shutil.copytree(run_folder, tmp_path / "run")
    next((tmp_path / "run").rglob("metrics.json")).unlink()
    assert main(["weights", "pack", str(tmp_path / "run"), "--folder", str(package)]) == 2
    assert "run `lightning test` first" in capsys.readouterr().err


@pytest.mark.parametrize(("scale", "code", "words"), [(1.0, 0, "8 of 8 numbers"), (4.0, 1, "the cards do not hold")])
def test_a_check_says_whether_the_cards_hold(package, monkeypatch, capsys, scale, code, words):
    def measured(weights, seed, build, say):
        return check.compare(weights.name, made_up_metrics(), made_up_metrics(scale=scale))

    monkeypatch.setattr(check, "check", measured)
    assert main(["weights", "check", "--seed", "12"]) == code
    assert words in capsys.readouterr().out


def test_studies_are_of_generated_objects_or_of_a_labelled_set(package, monkeypatch, capsys, tmp_path):
    metrics = made_up_metrics(1.0)
    asked = []

    def run(study, _):
        asked.append((study.seed, study.elsewhere))
        return [("nothing", metrics)]

    monkeypatch.setattr(ablation.Study, "run", run)
    monkeypatch.setattr(ablation, "as_markdown", lambda found: "a table")
    assert main(["weights", "ablate", "laptop-complete", "--seed", "3"]) == 0
    assert "laptop-complete, data seed 3, " in capsys.readouterr().out
    assert main(["weights", "ablate", "laptop", "--source", "urdf", "--root", str(tmp_path)]) == 0
    assert f"laptop-complete, {tmp_path}, urdf, " in capsys.readouterr().out
    assert asked == [(3, None), (57, ("urdf", tmp_path))]
    assert main(["weights", "ablate", "laptop", "--discovery", "--source", "urdf"]) == 2
    assert "--source: part discovery is tested on clouds of --seed only" in capsys.readouterr().err


def test_a_rebuild_passes_on_what_is_asked_for_and_tells_what_failed(package, monkeypatch, capsys):
    asked = []

    def fake(build, say, categories, views, folder):
        asked.append((list(categories), list(views)))
        return ["oven-depth: fit failed"]

    monkeypatch.setattr(rebuild, "rebuild", fake)
    assert main(["weights", "rebuild", "--categories", "oven", "--views", "depth"]) == 1
    assert asked == [(["oven"], ["depth"])]
    assert "oven-depth: fit failed" in capsys.readouterr().err
