"""What shipped weights are worth without each thing that they have learnt after training."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from packable import shipped_in, trained
from synthetic import write_synthetic_set

from articulate_ssl.pretrained import ablation as module
from articulate_ssl.pretrained.ablation import ABLATIONS, NOTHING, Study, as_markdown, columns_as_markdown
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import ShippedWeights, shipped_weights
from datamodules.manifest import ManifestError


@pytest.fixture
def shipped(tmp_path) -> ShippedWeights:
    """Weights of a tiny module that knows joint limits, with a card."""
    network = trained(tmp_path)
    network.states.seen.copy_(torch.tensor([[-9.0, 9.0]]))
    return shipped_in(tmp_path, network, "python -m render.generate --category laptop --seed 11")


def test_what_weights_have_is_left_out_one_after_the_other_and_once(shipped, tmp_path, monkeypatch):
    made, known = [], []

    def data(_, seed: int, place: Path) -> None:
        made.append(seed)
        write_synthetic_set(place / "data")

    tested = module.tested

    def noted(network, *rest):
        known.append((network.states.learnt, bool(network.estimator.final.cycles)))
        return tested(network, *rest)

    monkeypatch.setattr(module, "make_data", data)
    monkeypatch.setattr(module, "tested", noted)
    study, said = Study(shipped, 57, 6, tmp_path / "build"), []
    found = study.run(said.append)
    names = [name for name, _ in found]
    assert names == [NOTHING, "joint limits", "the cloud's own proportions, and all that builds on them"]
    assert known == [(True, True), (False, True), (True, False)]
    assert all(metrics["samples"] == 6 for _, metrics in found)
    assert [json.dumps(metrics) for _, metrics in study.run(said.append)] == [json.dumps(m) for _, m in found]
    assert made == [57] and len(known) == 3
    lines = as_markdown(found).splitlines()
    assert len(lines) == 5 and lines[0].startswith("| without | R ° |") and lines[3].startswith("| joint limits |")
    assert len({line.count("|") for line in lines}) == 1
    Study(shipped, 57, 4, tmp_path / "build").run(said.append)
    assert len(known) == 6


def test_what_the_network_is_worth_and_registration_is_asked_of_the_same_clouds(shipped, tmp_path, monkeypatch):
    made = []

    def data(_, seed: int, place: Path) -> None:
        made.append(seed)
        write_synthetic_set(place / "data")

    monkeypatch.setattr(module, "make_data", data)
    study = Study(shipped, 57, 6, tmp_path / "build")
    found = study.columns(print)
    assert [name for name, _ in found] == ["no network", "network alone", "network, registered"]
    assert all(metrics["samples"] == 6 for _, metrics in found)
    assert len({metrics["r_err_deg"]["mean"] for _, metrics in found}) == 3
    assert json.dumps(study.columns(print)) == json.dumps(found)  # the time that it took, too: nothing is run again
    assert json.dumps(study.run(print)[0][1]["r_err_deg"]) == json.dumps(found[-1][1]["r_err_deg"])
    assert made == [57]
    lines = columns_as_markdown(found).splitlines()
    assert lines[0].endswith("| s / cloud |") and len({line.count("|") for line in lines}) == 1


def test_a_labelled_set_may_say_what_things_are_worth(shipped, tmp_path, monkeypatch):
    root, made = tmp_path / "elsewhere", []

    def data(_, seed: int, place: Path) -> None:
        made.append(seed)
        write_synthetic_set(place / "data")

    monkeypatch.setattr(module, "make_data", data)
    with pytest.raises(ManifestError, match="no complete data set here"):
        Study(shipped, 57, 5, tmp_path / "build", ("procedural", root)).run(print)
    assert not made, "asked for before anything is generated"
    write_synthetic_set(root, seed=3, test_instances=2)
    studies = [Study(shipped, 57, 5, tmp_path / "build", elsewhere) for elsewhere in (("procedural", root), None)]
    there, here = (study.run(print) for study in studies)
    assert [name for name, _ in there] == [name for name, _ in here]
    assert all(metrics["samples"] == 5 for _, metrics in there)
    assert there[0][1]["r_err_deg"]["mean"] != here[0][1]["r_err_deg"]["mean"]
    shutil.rmtree(root)
    write_synthetic_set(root, seed=4, test_instances=2)
    assert studies[0].run(print)[0][1]["r_err_deg"]["mean"] != there[0][1]["r_err_deg"]["mean"], "another set by now"


@pytest.mark.parametrize("ablation", ABLATIONS[1:], ids=lambda one: one.name)
def test_what_was_left_out_is_not_known_any_more(ablation):
    """Of the weights in the package, which have all of it between them."""
    having = [w for w in shipped_weights() if ablation.known(load_module(w.file).estimator)]
    assert having, f"nothing in the package has {ablation.name}"
    estimator = load_module(having[0].file).estimator
    ablation.forget(estimator)
    assert not ablation.known(estimator)
