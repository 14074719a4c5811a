"""Weights in float16: what they keep, what they predict, and how names lead to them."""

from types import SimpleNamespace

import huggingface_hub
import pytest
import roma
import torch
from huggingface_hub import hub_mixin
from huggingface_hub.errors import LocalEntryNotFoundError
from safetensors.torch import save_file
from synthetic import write_synthetic_set
from tiny import POINTS, fit, tiny_module

from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, CheckpointError
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import shipped_weights
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.weights_card import WeightsCard
from articulate_ssl.training.weights_file import read_weights, write_weights

STATISTICS = {"mean": 1.5, "median": 1.0, "ci95": [1.0, 2.0]}
CARD = WeightsCard(
    category="laptop",
    view="complete",
    part_names=["base", "lid"],
    data={"command": "python -m render.generate --seed 5", "seed": 5, "train_instances": 3, "test_instances": 2},
    training={"command": "lightning fit", "seed": 0, "steps": 3, "commit": "abc"},
    metrics={"r_err_deg": STATISTICS, "samples": 16, "instances": 2, "failures": 0},
    weaknesses=["closed lids"],
    date="2026-01-02",
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A module after some steps, and its checkpoint."""
    folder = tmp_path_factory.mktemp("weights")
    write_synthetic_set(folder)
    # Without proportions: these clouds are no objects, and descent on noise is chaotic.
    module = tiny_module(steps=8, warmup_steps=6, inference=InferenceOptions(proportions=0))
    fit(module, folder, 8).save_checkpoint(folder / "trained.ckpt")
    return module.eval(), folder / "trained.ckpt"


@pytest.fixture
def package(tmp_path, monkeypatch, trained):
    """A package whose only weights are those of `trained`."""
    folder = tmp_path / "package"
    folder.mkdir()
    write_weights(trained[0], folder / "laptop-complete.safetensors")
    CARD.save(folder / "laptop-complete.json")
    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", folder)
    return folder


@pytest.fixture
def no_network(monkeypatch):
    """Whatever asks for the hub does not get it."""

    def refuse(*_args, **_kwargs):
        raise LocalEntryNotFoundError("cannot reach the hub")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", refuse)


def test_half_precision_predicts_what_the_checkpoint_predicts(trained, tmp_path):
    module, path = trained
    write_weights(module, tmp_path / "half.safetensors")
    clouds = torch.rand(8, POINTS, 3, generator=torch.Generator().manual_seed(5)) - 0.5
    whole, half = (load_module(p).predict_points(clouds) for p in (path, tmp_path / "half.safetensors"))
    angle = roma.rotmat_geodesic_distance(whole.part_pose[..., :3, :3], half.part_pose[..., :3, :3])
    assert angle.rad2deg().max() < 0.5
    torch.testing.assert_close(half.part_pose[..., :3, 3], whole.part_pose[..., :3, 3], atol=1e-2, rtol=0)


def test_weights_are_the_checkpoints_in_float16_and_geometry_is_exact(trained, tmp_path):
    module, _ = trained
    write_weights(module, tmp_path / "half.safetensors")
    halved, state = load_module(tmp_path / "half.safetensors").state_dict(), module.state_dict()
    kept = ("articulated.category.", "radius.", "states.", "confidence.", "part_frames.")
    exact = {name for name in state if name.startswith(kept)}
    assert len(exact) > 8
    for name, value in state.items():
        assert torch.equal(halved[name], value if name in exact else value.half().float()), name


def test_saving_again_is_exact_byte_for_byte(trained, tmp_path):
    write_weights(trained[0], tmp_path / "one.safetensors")
    write_weights(load_module(tmp_path / "one.safetensors"), tmp_path / "two.safetensors")
    assert (tmp_path / "one.safetensors").read_bytes() == (tmp_path / "two.safetensors").read_bytes()


def test_options_come_back_and_training_state_stays_behind(trained, tmp_path):
    module, path = trained
    write_weights(module, tmp_path / "half.safetensors")
    loaded = load_module(tmp_path / "half.safetensors")
    assert dict(loaded.hparams) == dict(module.hparams)
    assert loaded.num_points == POINTS and not loaded.training
    assert loaded.recipe.kept() is None and module.recipe.kept() is not None
    assert (tmp_path / "half.safetensors").stat().st_size < path.stat().st_size / 4


def test_what_float16_cannot_hold_is_refused(tmp_path):
    module = tiny_module()
    with torch.no_grad():
        next(module.articulated.backbone.parameters()).fill_(1e6)
    with pytest.raises(CheckpointError, match=r"x\.safetensors: articulated\.backbone.* infinite.*train again"):
        write_weights(module, tmp_path / "x.safetensors")
    assert not list(tmp_path.iterdir())


def test_damaged_and_foreign_weights_are_refused(trained, tmp_path):
    write_weights(trained[0], tmp_path / "cut.safetensors")
    content = (tmp_path / "cut.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(content[: len(content) // 2])
    save_file({"weight": torch.ones(2)}, tmp_path / "foreign.safetensors")
    for name, problem in (("none", "no such file"), ("cut", "damaged"), ("foreign", "another project")):
        with pytest.raises(CheckpointError, match=rf"{name}\.safetensors: .*{problem}"):
            read_weights(tmp_path / f"{name}.safetensors")


@pytest.mark.parametrize("metadata", ["{}", "no JSON", "[]", "3"])
def test_damaged_metadata_are_refused(tmp_path, metadata):
    save_file({"weight": torch.ones(2)}, tmp_path / "x.safetensors", {CHECKPOINT_KEY: metadata})
    with pytest.raises(CheckpointError, match=r"x\.safetensors: damaged, its metadata.*copy it again"):
        load_module(tmp_path / "x.safetensors")


@pytest.mark.parametrize(
    "change",
    [
        {"hyper_parameters": 3},
        {"hyper_parameters": {"network": 3}},
        {"state_dict": []},
        {CHECKPOINT_KEY: 1},
        {CHECKPOINT_KEY: {"version": 2}},
    ],
)
def test_a_checkpoint_of_another_form_is_refused(trained, tmp_path, change):
    torch.save(torch.load(trained[1], weights_only=True) | change, tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match=r"x\.ckpt: does not fit this version"):
        load_module(tmp_path / "x.ckpt")


def test_checkpoints_of_before_confidence_was_learnt_still_load(trained, tmp_path):
    content = torch.load(trained[1], weights_only=True)
    content["state_dict"] = {k: v for k, v in content["state_dict"].items() if not k.startswith("confidence.")}
    torch.save(content, tmp_path / "old.ckpt")
    assert not load_module(tmp_path / "old.ckpt").confidence.learnt
    del content["state_dict"]["articulated.category.axis"]
    torch.save(content, tmp_path / "less.ckpt")
    with pytest.raises(CheckpointError, match="does not fit this version"):
        load_module(tmp_path / "less.ckpt")


def test_a_shipped_name_never_touches_the_network(package, no_network, trained):
    for name in ("laptop", "laptop-complete"):
        module = ArticulatedPoseModule.from_pretrained(name)
        assert module.category == "laptop" and module.card == CARD
    state = trained[0].state_dict()
    assert torch.equal(module.state_dict()["articulated.category.template"], state["articulated.category.template"])


def test_a_view_that_is_not_shipped_is_refused(package, no_network):
    with pytest.raises(CheckpointError, match=r"laptop: no weights for view 'depth'.*only complete"):
        ArticulatedPoseModule.from_pretrained("laptop", view="depth")


def test_without_a_network_a_hub_name_gets_a_clear_word(package, no_network):
    with pytest.raises(CheckpointError, match=r"somebody/oven: .*Hugging Face hub.*cannot reach.*laptop-complete"):
        ArticulatedPoseModule.from_pretrained("somebody/oven")


def test_other_names_are_not_looked_up_on_the_hub(package, monkeypatch):
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda *_, **__: pytest.fail("asked the hub"))
    with pytest.raises(CheckpointError, match=r"toaster: neither a file nor .*laptop-complete"):
        ArticulatedPoseModule.from_pretrained("toaster")
    with pytest.raises(CheckpointError, match=r"some/missing\.ckpt: no such checkpoint"):
        ArticulatedPoseModule.from_pretrained("some/missing.ckpt")


def test_a_hub_name_is_downloaded_with_its_options(package, monkeypatch):
    asked = {}

    def download(repository, file, **options):
        asked.update(options, repository=repository, file=file)
        return str(package / "laptop-complete.safetensors")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert ArticulatedPoseModule.from_pretrained("somebody/oven", revision="v2").category == "laptop"
    assert (asked["repository"], asked["file"], asked["revision"]) == ("somebody/oven", "model.safetensors", "v2")


def test_a_saved_folder_comes_back_with_its_card(package, no_network, tmp_path):
    module = ArticulatedPoseModule.from_pretrained("laptop")
    module.save_pretrained(tmp_path / "mine")
    again = ArticulatedPoseModule.from_pretrained(tmp_path / "mine")
    assert again.card == CARD
    for name, value in module.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    page = (tmp_path / "mine" / "README.md").read_text()
    assert "license: apache-2.0" in page and "closed lids" in page and "lightning fit" in page
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"holds no model\.safetensors"):
        ArticulatedPoseModule.from_pretrained(tmp_path / "empty")


def test_what_is_pushed_to_the_hub_is_what_from_pretrained_reads(trained, monkeypatch):
    pushed = {}

    class Hub:
        def __init__(self, token=None):
            pass

        def create_repo(self, repo_id, **_):
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, repo_id, folder_path, **_):
            pushed["files"] = {file.name for file in folder_path.iterdir()}
            pushed["module"] = ArticulatedPoseModule.from_pretrained(folder_path)
            return repo_id

    monkeypatch.setattr(hub_mixin, "HfApi", Hub)
    assert trained[0].push_to_hub("somebody/laptop") == "somebody/laptop"
    assert {"model.safetensors", "README.md"} <= pushed["files"]
    assert dict(pushed["module"].hparams) == dict(trained[0].hparams)


def test_a_damaged_card_is_named(package):
    (package / "laptop-complete.json").write_text('{"category": "laptop"}')
    with pytest.raises(CheckpointError, match=r"laptop-complete\.json: no card of weights"):
        ArticulatedPoseModule.from_pretrained("laptop")
