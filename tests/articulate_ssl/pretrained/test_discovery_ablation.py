"""What part discovery finds without each of the things that it does."""

import json
import shlex
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import yaml
from packable import DATA_SEED, shipped_in, stand_in_generator
from tiny import DISCOVERY, NETWORK, POINTS, tiny_module

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.pretrained import discovery_ablation as module
from articulate_ssl.pretrained.ablation import NOTHING
from articulate_ssl.pretrained.discovery_ablation import DISCOVERY_ABLATIONS, DiscoveryStudy, as_markdown
from articulate_ssl.training.recipes.staged import TrainingRecipe
from articulate_ssl.training.shipped_weights import ShippedWeights
from articulate_ssl.training.weights_card import WeightsCard

DATA = "python -m render.generate --category laptop --seed 11 --train-instances 1000 --test-instances 100"
TEMPLATES = "templates beyond the first"


@pytest.fixture
def shipped(tmp_path) -> ShippedWeights:
    """Weights whose card says that they were trained by a tiny configuration."""
    file = tmp_path / "tiny.yaml"
    model = {"num_parts": 2, "network": asdict(NETWORK), "discovery": asdict(replace(DISCOVERY, references=2))}
    data = {"category": "laptop", "num_points": POINTS, "batch_size": 4}
    file.write_text(yaml.safe_dump({"data": data, "model": model, "trainer": {"max_steps": 6}}))
    weights = shipped_in(tmp_path, tiny_module(), DATA)
    _rewrite(weights, training={"command": f"lightning fit -c {file} --seed_everything 0", "commit": "abc"})
    return weights


def _rewrite(weights: ShippedWeights, **changes) -> None:
    card = weights.file.with_suffix(".json")
    replace(WeightsCard.load(card), **changes).save(card)


def _study(shipped: ShippedWeights, folder: Path, samples: int = 6) -> DiscoveryStudy:
    return DiscoveryStudy(shipped, 57, samples, folder / "build")


def test_parts_are_found_anew_without_one_thing_after_the_other_and_once(shipped, tmp_path, monkeypatch):
    commands, options = stand_in_generator(monkeypatch), []
    prepare = TrainingRecipe.prepare

    def noted(self, *rest):
        options.append(self.discovery)
        prepare(self, *rest)

    monkeypatch.setattr(TrainingRecipe, "prepare", noted)
    found = _study(shipped, tmp_path).run(print)
    assert [name for name, _ in found] == [NOTHING, TEMPLATES]
    assert [one.references for one in options] == [2, 1]
    assert options[1] == replace(options[0], references=1)
    assert all(metrics["samples"] == 6 and metrics["minutes"] > 0 for _, metrics in found)
    assert shlex.join(commands[0]).count("--train-instances 192") == 1 and "57" in commands[0]
    again = _study(shipped, tmp_path).run(print)
    assert json.dumps(again) == json.dumps(json.loads(json.dumps(found))) and len(options) == 2 and len(commands) == 1
    lines = as_markdown(found).splitlines()
    assert len(lines) == 4 and lines[0].endswith("| minutes |") and len({line.count("|") for line in lines}) == 1
    _study(shipped, tmp_path, samples=4).run(print)
    assert len(options) == 4


def test_what_is_searched_is_what_was_discovered(shipped, tmp_path, monkeypatch):
    """And not what the weights had learnt: another discovery, another answer."""
    stand_in_generator(monkeypatch)
    (_, own), (_, other) = _study(shipped, tmp_path).run(print)
    assert own["seg_miou"]["mean"] != other["seg_miou"]["mean"]


def test_where_no_parts_are_found_the_table_says_so(shipped, tmp_path, monkeypatch):
    def nothing(*_):
        raise DiscoveryError("no part that moves")

    stand_in_generator(monkeypatch)
    monkeypatch.setattr(TrainingRecipe, "prepare", nothing)
    found = _study(shipped, tmp_path).run(print)
    assert all(metrics["discovery_error"] == "no part that moves" for _, metrics in found)
    lines = as_markdown(found).splitlines()
    assert "| no parts found |" in lines[2] and len({line.count("|") for line in lines}) == 1


def test_scans_that_taught_views_are_of_other_objects(shipped, tmp_path, monkeypatch):
    data = {"command": DATA, "seed": DATA_SEED, "scans": DATA.replace("11", "10")}
    _rewrite(shipped, data=data, setting="multi-state")
    commands = stand_in_generator(monkeypatch)
    monkeypatch.setattr(module, "DISCOVERY_ABLATIONS", ())
    _study(shipped, tmp_path).run(print)
    seeds = [command[command.index("--seed") + 1] for command in commands]
    objects = [command[command.index("--train-instances") + 1] for command in commands]
    assert seeds == ["57", "58"] and objects == ["60", "60"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {NOTHING, TEMPLATES}),
        (
            {"joint_type": "prismatic", "discovery": replace(DISCOVERY, grouped=True)},
            {"objects beyond the first", "proposals of parts that slide", "knowing which clouds show one object"},
        ),
        ({"orientation_range": 100.0}, {TEMPLATES, "knowing how far objects are turned"}),
    ],
    ids=["single clouds", "chests in several states", "views"],
)
def test_only_what_discovery_does_is_left_out(changes, expected):
    network = tiny_module(**changes)
    assert {one.name for one in DISCOVERY_ABLATIONS if one.applies(network)} == expected | {NOTHING}
