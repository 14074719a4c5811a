"""`make figures`: accuracy against noise, and how far features of one part depend on where another is."""

import csv
import json
import warnings

import pytest
import torch
from tiny import quiet_trainer, tiny_data, tiny_module, warmed_up

from articulate_ssl.paper_figures import noise_curve, part_features
from articulate_ssl.paper_figures.__main__ import main
from articulate_ssl.paper_figures.part_features import STEPS, PartFeatures
from datamodules.articulated_data_module import ArticulatedDataModule


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A set, and a module after its warm-up."""
    root = tmp_path_factory.mktemp("data")
    return root, warmed_up(root).eval()


def options(root, module) -> dict:
    return {"category": "laptop", "root": str(root), "num_points": module.num_points, "batch_size": 4}


def test_without_noise_it_is_what_lightning_test_says_and_noise_reaches_the_clouds(trained, tmp_path, monkeypatch):
    root, module = trained
    monkeypatch.setattr(noise_curve, "SIGMAS", (0.0, 0.5))
    found = noise_curve.measure(module, options(root, module), module.calibration_samples)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        quiet_trainer(tmp_path).test(module, tiny_data(root), verbose=False)
    said = json.loads((tmp_path / "metrics.json").read_text())
    for name, *_ in noise_curve.QUANTITIES:
        assert found[True][0][name] == said[name]
    assert found[True][1]["chamfer_l1"]["mean"] > found[True][0]["chamfer_l1"]["mean"] + 0.1
    files = noise_curve.write(found, "a title", tmp_path)
    rows = list(csv.DictReader((tmp_path / "noise.csv").open()))
    assert [(row["way"], float(row["sigma"])) for row in rows] == [
        (way, sigma) for way in ("network alone", "network, registered") for sigma in (0.0, 0.5)
    ]
    assert float(rows[2]["seg_miou_mean"]) == said["seg_miou"]["mean"]
    assert files[1].read_bytes().startswith(b"\x89PNG")


def test_one_part_moves_as_its_labels_say_and_the_other_stays(trained):
    root, module = trained
    data = ArticulatedDataModule(**options(root, module))
    data.setup("test")
    batch = next(iter(data.test_dataloader()))
    found = part_features.measure(module, batch)
    part = batch["dense_part_id"][0, : found.shown.shape[1]]
    stays = found.shown[:, part == 0]
    assert (stays - stays[:1]).abs().max() < 1e-6
    assert ((found.nearest >= 0) == (part == 0)).all()
    assert part[found.nearest[part == 0]].eq(0).all()
    # The axis stays where it is, and everything else turns about it by the difference of the states.
    lid = found.shown[:, part == 1]
    middle = lid[STEPS // 2] - lid[STEPS // 2].mean(dim=0)
    last = lid[-1] - lid[-1].mean(dim=0)
    u, _, v = torch.linalg.svd(middle.T @ last)
    turn = (v.mT @ torch.diag(torch.tensor([1.0, 1.0, torch.linalg.det(v.mT @ u.mT)])) @ u.mT).float()
    angle = ((turn.trace() - 1) / 2).clamp(-1, 1).acos()
    assert angle == pytest.approx(float(found.states[0, -1] - found.states[0, STEPS // 2]), abs=1e-3)
    # In the state of the cloud itself its own features come out.
    assert [found.change(kind)[0, STEPS // 2].item() for kind in (0, 1)] == [0, 0]
    assert (found.change(0)[:, 0] > 0).all()


def features_of(values: torch.Tensor, stays: torch.Tensor) -> PartFeatures:
    states = torch.linspace(0, 1, STEPS).expand(len(values), STEPS)
    return PartFeatures(stays, (values, values), states, torch.zeros(STEPS, 1, 3), torch.zeros(1, dtype=torch.long))


def test_change_is_none_for_features_that_stay_and_two_for_unrelated_ones():
    torch.manual_seed(0)
    stays = torch.ones(2, 400, dtype=torch.bool)
    stays[:, 300:] = False
    constant = torch.randn(2, 1, 400, 8).repeat(1, STEPS, 1, 1)
    constant[:, :, 300:] += torch.randn(2, STEPS, 100, 8)  # of the part that moves
    assert features_of(constant, stays).change(0).abs().max() < 1e-6
    unrelated = features_of(torch.randn(2, STEPS, 400, 8), stays).change(0)
    others = [i for i in range(STEPS) if i != STEPS // 2]
    assert torch.allclose(unrelated[:, others], torch.tensor(2.0), atol=0.15)


def test_weights_that_estimate_once_have_no_part_level_features():
    once = tiny_module(network={"iterations": 1})
    with pytest.raises(ValueError, match="estimate poses once"):
        part_features.measure(once, {})


def test_bad_input_is_named(tmp_path, capsys):
    assert main(["--category", "teapot"]) == 2
    assert "no weights of teapot" in capsys.readouterr().err
    assert main(["--category", "laptop", "--root", str(tmp_path)]) == 2
    assert f"{tmp_path}/laptop/procedural-complete/manifest.json: manifest is missing" in capsys.readouterr().err
