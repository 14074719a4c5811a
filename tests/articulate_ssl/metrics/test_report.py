import csv
import json

import pytest
import torch
from articulated_world import articulated_labels

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.objects import CSV_NAME as OBJECTS_NAME
from articulate_ssl.metrics.report import CSV_NAME, JSON_NAME, MULTI_STATE, write_report

META = {
    "category": "eyeglasses",
    "source": "procedural",
    "protocol": "complete",
    "checkpoint": "last.ckpt",
    "seconds_per_cloud": 0.25,
}


@pytest.fixture(scope="module")
def metrics() -> dict:
    labels = articulated_labels(num_parts=3)
    scored = ArticulatedPoseMetrics(calibrate(perfect_oracle(labels), labels), replicates=20)
    scored.update(perfect_oracle(labels), labels)
    return scored.compute()


def test_json_holds_metrics_and_origin(tmp_path, metrics):
    content = write_report(tmp_path / "new" / "run", metrics, **META, calibration={"slot_of_part": [0, 1, 2]})
    read = json.loads((tmp_path / "new" / "run" / JSON_NAME).read_text())
    assert read == content == metrics | META | {"calibration": {"slot_of_part": [0, 1, 2]}}


def test_csv_has_a_line_for_every_part_and_joint(tmp_path, metrics):
    write_report(tmp_path, metrics, **META, part_names=["frame", "left", "right"])
    with open(tmp_path / CSV_NAME, newline="") as file:
        lines = list(csv.DictReader(file))
    assert [row["of"] for row in lines if row["quantity"] == "r_err_deg"] == ["all", "frame", "left", "right"]
    assert [row["of"] for row in lines if row["quantity"] == "axis_err_deg"] == ["all", "joint 0", "joint 1"]
    miou = next(row for row in lines if row["quantity"] == "seg_miou")
    assert float(miou["mean"]) == metrics["seg_miou"]["mean"]
    assert float(miou["ci95_low"]) == metrics["seg_miou"]["ci95"][0]


def test_table_speaks_percent_and_degrees(tmp_path, metrics, capsys):
    write_report(tmp_path, metrics, **META)
    printed = capsys.readouterr().out
    assert "100.0 %" in printed
    assert "r_err_deg" in printed
    assert "24 clouds, 0 failures" in printed


def test_what_is_known_of_single_objects_has_a_file_and_flips_a_sentence(tmp_path, metrics, capsys):
    rate = torch.tensor([0.0, 0.5], dtype=torch.float64)
    objects = {"instance": torch.tensor([0, 1]), "samples": torch.tensor([12, 12]), "r_err_deg": rate}
    write_report(tmp_path, metrics, **META, per_object=(objects | {"flip_rate": rate}, ["narrow", "wide"]))
    assert (tmp_path / OBJECTS_NAME).read_text().splitlines()[1] == "wide,12,0.5,0.5"
    assert "6 of 6 flips are of 1 of 2 objects: wide" in " ".join(capsys.readouterr().out.split())


def test_a_setting_that_is_not_the_usual_one_is_named(tmp_path, metrics, capsys):
    write_report(tmp_path, {"setting": MULTI_STATE} | metrics, **META)
    assert "complete, multi-state: 24 clouds" in " ".join(capsys.readouterr().out.split())
    assert json.loads((tmp_path / JSON_NAME).read_text())["setting"] == "multi-state"
    assert "setting" not in (tmp_path / CSV_NAME).read_text()


def test_missing_values_are_null_and_empty(tmp_path):
    nothing = {"mean": None, "median": None, "ci95": None}
    write_report(tmp_path, {"pivot_err": nothing, "samples": 1, "failures": 0}, **META)
    assert json.loads((tmp_path / JSON_NAME).read_text())["pivot_err"] == nothing
    assert "pivot_err,all,,,," in (tmp_path / CSV_NAME).read_text()


def test_a_nan_is_refused_and_nothing_already_written_is_lost(tmp_path, metrics):
    write_report(tmp_path, metrics, **META)
    before = (tmp_path / JSON_NAME).read_bytes()
    bad = metrics | {"t_err": {"mean": float("nan"), "median": 0.0, "ci95": None}}
    with pytest.raises(ValueError, match="JSON"):
        write_report(tmp_path, bad, **META)
    with pytest.raises(ValueError, match="t_err"):
        write_report(tmp_path, metrics, **META, t_err=1)
    assert (tmp_path / JSON_NAME).read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == [CSV_NAME, JSON_NAME]
