"""Shipped weights on labelled objects of another source than they were trained on."""

import csv
import json

import pytest
from packable import shipped_in, stand_in_generator, trained
from synthetic import write_synthetic_set

from articulate_ssl.cli import main
from articulate_ssl.pretrained import elsewhere
from articulate_ssl.pretrained.elsewhere import CALIBRATION_SEED, measured_elsewhere
from articulate_ssl.training import shipped_weights
from datamodules.manifest import MANIFEST_NAME, ManifestError

COMMAND = "python -m render.generate --category laptop --seed 11 --train-instances 73"


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Weights of a tiny module with a card, and a stand-in for the generator."""
    return shipped_in(tmp_path, trained(tmp_path), COMMAND), stand_in_generator(monkeypatch)


def other_objects(root, test_instances: int = 2, **changes) -> None:
    """A synthetic set, as if its objects were CAD."""
    folder = write_synthetic_set(root, seed=3, test_instances=test_instances)
    folder = folder.rename(folder.with_name("partnet-mobility-complete"))
    manifest = json.loads((folder / MANIFEST_NAME).read_text())
    (folder / MANIFEST_NAME).write_text(json.dumps(manifest | {"source": "partnet-mobility"} | changes))


def test_objects_of_another_source_are_scored_by_what_generated_clouds_calibrate(shipped, tmp_path):
    weights, made = shipped
    other_objects(tmp_path / "data")
    for samples in (None, 5):
        metrics, place = measured_elsewhere(
            weights, "partnet-mobility", tmp_path / "data", tmp_path / "build", print, samples
        )
        assert metrics == json.loads((place / "metrics.json").read_text())
        assert (metrics["source"], metrics["samples"]) == ("partnet-mobility", samples or 16)
        rows = list(csv.DictReader((place / "objects.csv").open()))
        assert sum(int(row["samples"]) for row in rows) == metrics["samples"]
    (words,) = made  # calibration clouds are made once
    assert words[words.index("--seed") + 1] == str(CALIBRATION_SEED)


def test_what_cannot_be_tested_says_why_before_anything_is_generated(shipped, tmp_path):
    weights, made = shipped
    where = ("partnet-mobility", tmp_path / "data", tmp_path / "build", print)
    with pytest.raises(ManifestError, match=r"no complete data set here\. Make it with"):
        measured_elsewhere(weights, *where)
    other_objects(tmp_path / "data", labelled=False)
    with pytest.raises(ManifestError, match="no labels to compare with"):
        measured_elsewhere(weights, *where)
    other_objects(tmp_path / "untested", test_instances=0)
    with pytest.raises(ManifestError, match="no test clouds; make it with"):
        measured_elsewhere(weights, where[0], tmp_path / "untested", *where[2:])
    assert not made


def test_the_command_says_where_results_are(shipped, tmp_path, monkeypatch, capsys):
    seen = []

    def stand_in(weights, source, root, build, say, samples):
        seen.append((weights.name, source, str(root), samples))
        return {}, build / "results"

    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", shipped[0].file.parent)
    monkeypatch.setattr(elsewhere, "measured_elsewhere", stand_in)
    words = ["weights", "test", "laptop", "--source", "shape2motion", "--samples", "7", "--root", "mine"]
    assert main(words) == 0
    assert seen == [("laptop-complete", "shape2motion", "mine", 7)]
    assert "build/weights-test/results/metrics.json" in capsys.readouterr().out
    monkeypatch.undo()
    assert main(["weights", "test", "laptop-complete", "--source", "urdf", "--root", str(tmp_path)]) == 2
    assert "no complete data set here" in capsys.readouterr().err
