"""A card says what the run was, and nothing that the run was not."""

import json
import shlex
import shutil

import pytest
import yaml
from packable import ROOT, made_up_metrics, write_run

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.pretrained.pack import fit_command, generate_arguments, newest_metrics, pack, weaknesses
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.weights_card import WeightsCard
from datamodules.manifest import MANIFEST_NAME, Manifest
from render.generate import _parser


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pack")
    write_run(folder)
    return folder


@pytest.fixture
def run(original, tmp_path, monkeypatch):
    """A run of its own, beside the data that all share."""
    monkeypatch.chdir(ROOT)
    shutil.copytree(original / "run", tmp_path / "run")
    return tmp_path / "run"


def test_weights_and_card_of_a_run_are_packed(run, tmp_path):
    metrics = newest_metrics(run)
    weights = pack(metrics, commit="abc", folder=tmp_path / "weights")
    assert {file.name for file in (tmp_path / "weights").iterdir()} == {
        "laptop-complete.safetensors",
        "laptop-complete.json",
    }
    assert load_module(weights.file).confidence.learnt
    card = WeightsCard.load(weights.file.with_suffix(".json"))
    assert (card.category, card.view, card.part_names) == ("laptop", "complete", ["base", "lid"])
    assert card.training == {
        "command": "lightning fit -c configs/laptop.yaml -c configs/profiles/cpu.yaml --seed_everything 0",
        "seed": 0,
        "steps": 1000,
        "commit": "abc",
    }
    assert card.metrics["r_err_deg"] == made_up_metrics()["r_err_deg"] and card.setting is None
    for words in ("abc", "16 clouds of 4 objects", card.data["command"], *card.weaknesses):
        assert words in card.markdown()


def test_the_command_for_the_data_is_one_that_the_generator_takes(run, tmp_path):
    weights = pack(newest_metrics(run), folder=tmp_path)
    card = WeightsCard.load(weights.file.with_suffix(".json"))
    _, _, module, *words = shlex.split(card.data["command"])
    options = _parser().parse_args(words)
    assert module == "render.generate" and options.seed == card.data["seed"] == 11
    assert (options.train_instances, options.test_instances, options.states) == (3, 2, 4)


def test_the_command_for_data_says_what_states_of_hinges_they_have(original):
    (file,) = original.glob(f"**/{MANIFEST_NAME}")
    manifest = Manifest.load(file.parent)
    assert not hasattr(_parser().parse_args(generate_arguments(manifest)), "range_deg")
    manifest.options["range_deg"] = [0.0, 30.5]
    assert _parser().parse_args(generate_arguments(manifest)).range_deg == [0, 30.5]


def test_a_run_with_other_options_gets_no_card(run, tmp_path):
    file = newest_metrics(run).with_name("config.yaml")
    config = yaml.safe_load(file.read_text())
    config["model"]["schedule"]["steps"] = 7
    file.write_text(yaml.safe_dump(config))
    with pytest.raises(CheckpointError, match=r"model\.schedule\.steps is 7, not 1000"):
        pack(newest_metrics(run), folder=tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


def test_the_multi_state_setting_is_on_the_card(run, tmp_path):
    """Read from the metrics; a configuration that does not fit them is refused."""
    file = newest_metrics(run)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"setting": "multi-state"}))
    with pytest.raises(CheckpointError, match=r"model\.discovery\.grouped is None, not True"):
        pack(file, folder=tmp_path / "weights")
    config = yaml.safe_load(file.with_name("config.yaml").read_text())
    config["model"] |= yaml.safe_load((ROOT / "configs/profiles/multi_state.yaml").read_text())["model"]
    file.with_name("config.yaml").write_text(yaml.safe_dump(config))
    card = WeightsCard.load(pack(file, folder=tmp_path / "weights").file.with_suffix(".json"))
    assert card.setting == "multi-state" and "-c configs/profiles/multi_state.yaml" in card.training["command"]
    assert "multi-state. Training knew" in card.markdown()


def test_metrics_of_another_category_are_refused(run, tmp_path):
    file = newest_metrics(run)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"category": "oven"}))
    with pytest.raises(CheckpointError, match="of oven, but the checkpoint is of laptop"):
        pack(file, folder=tmp_path)


def test_a_run_without_a_test_is_refused(run):
    newest_metrics(run).unlink()
    with pytest.raises(CheckpointError, match="run `lightning test` first"):
        newest_metrics(run)


def test_every_file_that_a_command_names_exists():
    for options in (("complete", 0), ("depth", 0), ("complete", 0, True), ("depth", 0, True)):
        words = fit_command("washing_machine", *options)
        assert all((ROOT / word).is_file() for word in words if word.endswith(".yaml"))


def test_weaknesses_are_read_from_the_numbers():
    def told(**changes) -> str:
        return " ".join(weaknesses(made_up_metrics(**changes), ["base", "lid"], "complete"))

    good, bad = told(), told(scale=6.0)
    for words in ("turned by more than 90 degrees", "IoU of", "axis of joint 0", "line of joint 0"):
        assert words in bad and words not in good
    assert "state of joint 0 is off by 30 degrees" in told(state=30.0)
    assert "4 test objects" in good and "from all sides" in good
