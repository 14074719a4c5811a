"""`lightning test --model.inference.columns true`: three ways to predict, from the same clouds in one run."""

import csv
import json
import warnings
from pathlib import Path

import pytest
import torch
from synthetic import write_synthetic_set
from tiny import quiet_trainer, tiny_data, tiny_module, warmed_up
from unlabelled import without_labels

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training.columns import NETWORK, NO_NETWORK, REGISTERED


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A set, and a module after its warm-up."""
    root = tmp_path_factory.mktemp("data")
    module = warmed_up(root)
    return root, module.state_dict(), module.recipe.kept()


def _tested(trained, out: Path, inference: InferenceOptions, spoil: bool = False) -> dict:
    root, weights, kept = trained
    module = tiny_module(inference=inference)
    module.load_state_dict(weights)
    module.recipe.restore(kept)
    if spoil:
        with torch.no_grad():
            for parameter in module.articulated.backbone.parameters():
                parameter.add_(torch.randn_like(parameter))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quiet_trainer(out).test(module, tiny_data(root), verbose=False)
    return json.loads((out / "metrics.json").read_text())


def _errors(report: dict) -> dict:
    return {name: value for name, value in report.items() if isinstance(value, dict) and "ci95" in value}


def test_three_columns_and_the_tests_own_numbers(trained, tmp_path):
    plain = _tested(trained, tmp_path / "plain", InferenceOptions())
    report = _tested(trained, tmp_path / "columns", InferenceOptions(columns=True))
    assert "columns" not in plain
    assert _errors(report) == _errors(plain)
    columns = report["columns"]
    assert list(columns) == [NO_NETWORK, NETWORK, REGISTERED]
    assert _errors(columns[REGISTERED]) == _errors(plain)
    alone = _tested(trained, tmp_path / "alone", InferenceOptions(refine=False))
    assert _errors(columns[NETWORK]) == _errors(alone)
    assert columns[NETWORK]["calibration"] == alone["calibration"] != columns[NO_NETWORK]["calibration"]
    assert columns[NETWORK]["chamfer_l1"] != columns[REGISTERED]["chamfer_l1"] != columns[NO_NETWORK]["chamfer_l1"]
    assert all(column["seconds_per_cloud"] > 0 and column["samples"] == 16 for column in columns.values())
    with (tmp_path / "columns" / "columns.csv").open() as file:
        rows = {(row["quantity"], row["of"]): row for row in csv.DictReader(file)}
    assert float(rows["t_err", "all"]["network_mean"]) == columns[NETWORK]["t_err"]["mean"]
    assert ("seg_miou", "lid") in rows


def test_no_network_is_none(trained, tmp_path):
    """Other weights change what the network says, and nothing of what is found without it."""
    inference = InferenceOptions(columns=True, refine=False)
    columns = [_tested(trained, tmp_path / str(spoil), inference, spoil)["columns"] for spoil in (False, True)]
    assert _errors(columns[0][NO_NETWORK]) == _errors(columns[1][NO_NETWORK])
    assert _errors(columns[0][NETWORK]) != _errors(columns[1][NETWORK])


def test_search_stays_within_the_orientation_range(trained):
    module = tiny_module(orientation_range=60.0)
    clouds = torch.rand(3, 48, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    rotation = module.estimator.search(clouds).base_pose[:, :3, :3]
    assert module.orientation.contains(rotation).all()


def test_only_the_network_of_the_paper_is_left_out(monkeypatch):
    """What is searched for it is sought among the turns of the cube, and on the other side, as ever."""
    estimator, asked = tiny_module().estimator, []
    for search in (estimator.square_search, estimator.other_views):
        monkeypatch.setattr(search, "sought", lambda *of, sought=search.sought: (asked.append(1), sought(*of))[1])
    monkeypatch.setattr(estimator, "align", lambda _: pytest.fail("the network is asked"))
    estimator.search(torch.rand(3, 48, 3, generator=torch.Generator().manual_seed(1)) - 0.5)
    assert len(asked) == 2


def test_a_set_without_labels_is_refused(trained, tmp_path):
    without_labels(write_synthetic_set(tmp_path))
    with pytest.raises(ValueError, match="no labels"):
        quiet_trainer(tmp_path).test(tiny_module(inference=InferenceOptions(columns=True)), tiny_data(tmp_path))
