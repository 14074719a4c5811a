"""The DataModule inside and outside a Lightning Trainer: resuming, workers, ranks, and errors a user meets."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from synthetic import write_synthetic_set
from torch.utils.data import DistributedSampler
from unlabelled import without_labels

from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import Manifest, ManifestError
from datamodules.shards import ShardError


class Recorder(LightningModule):
    """Learns one number and remembers every batch it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.seen: dict[str, list] = {"train": [], "val": [], "test": []}

    def record(self, batch: dict[str, torch.Tensor], stage: str) -> torch.Tensor:
        self.seen[stage].append({name: value.clone() for name, value in batch.items()})
        return (self.weight * batch["points"][..., 0]).square().mean()

    def training_step(self, batch, batch_idx):
        return self.record(batch, "train")

    def validation_step(self, batch, batch_idx):
        self.record(batch, "val")

    def test_step(self, batch, batch_idx):
        self.record(batch, "test")

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def trainer(folder: Path, **options) -> Trainer:
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    options = {"accelerator": "cpu", "enable_checkpointing": False, "num_sanity_val_steps": 0} | quiet | options
    return Trainer(default_root_dir=folder, **options)


def data(root: Path, **options) -> ArticulatedDataModule:
    return ArticulatedDataModule(
        "laptop", root=str(root), **{"num_points": 32, "batch_size": 4, "val_samples": 5} | options
    )


def fit(
    root: Path, steps: int, checkpoint: Path | None = None, trainer_options=None, **options
) -> tuple[Recorder, Trainer]:
    model, run = Recorder(), trainer(root, max_steps=steps, **(trainer_options or {}))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not have many workers.*")
        run.fit(model, data(root, **options), ckpt_path=checkpoint)
    return model, run


def assert_same_batches(first: list, second: list) -> None:
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        assert a.keys() == b.keys()
        assert all(torch.equal(a[name], b[name]) for name in a)


# 12 training samples in batches of 4: 3 steps end an epoch, 2 and 4 stop inside one.
@pytest.mark.parametrize("stop", [2, 3, 4])
def test_a_resumed_run_sees_the_batches_of_an_uninterrupted_one(tmp_path, synthetic_set, stop):
    whole, _ = fit(tmp_path, 7)
    first, run = fit(tmp_path, stop)
    run.save_checkpoint(tmp_path / "last.ckpt")
    second, _ = fit(tmp_path, 7, tmp_path / "last.ckpt")
    assert_same_batches(first.seen["train"] + second.seen["train"], whole.seen["train"])
    assert torch.equal(second.weight, whole.weight)


def test_loader_processes_running_ahead_do_not_move_the_resume_point(tmp_path, synthetic_set):
    whole, _ = fit(tmp_path, 6)
    first, run = fit(tmp_path, 2, num_workers=2)
    run.save_checkpoint(tmp_path / "last.ckpt")
    second, _ = fit(tmp_path, 6, tmp_path / "last.ckpt", num_workers=1)
    assert_same_batches(first.seen["train"] + second.seen["train"], whole.seen["train"])


def test_resuming_without_a_trainer(tmp_path, synthetic_set):
    whole = data(tmp_path)
    whole.setup("fit")
    batches = [batch for _ in range(2) for batch in consume(whole, 3)]
    first, second = data(tmp_path), data(tmp_path)
    first.setup("fit")
    begun = consume(first, 2)
    second.setup("fit")
    second.load_state_dict(first.state_dict())
    assert_same_batches(begun + consume(second, 3), batches[:5])


def consume(module: ArticulatedDataModule, steps: int) -> list:
    """The next batches of a hand-written training loop."""
    loader = iter(module.train_dataloader())
    batches = [next(loader) for _ in range(steps)]
    module.consumed_samples += sum(len(batch["sample"]) for batch in batches)
    return batches


def test_every_fit_without_a_checkpoint_starts_the_stream_anew(tmp_path, synthetic_set):
    module, seen = data(tmp_path), []
    for _ in range(2):
        model = Recorder()
        trainer(tmp_path, max_steps=2).fit(model, module)
        seen.append(model.seen["train"])
    assert_same_batches(*seen)


def test_validation_is_a_fixed_part_of_the_training_clouds_and_consumes_nothing(tmp_path, synthetic_set):
    model, run = fit(tmp_path, 4, trainer_options={"val_check_interval": 2, "check_val_every_n_epoch": None})
    assert [len(batch["sample"]) for batch in model.seen["val"]] == [4, 1, 4, 1]
    assert_same_batches(model.seen["val"][:2], model.seen["val"][2:])
    assert run.datamodule.state_dict() == {"consumed_samples": 16}
    whole, _ = fit(tmp_path, 4, val_samples=0)
    assert_same_batches(model.seen["train"], whole.seen["train"])


def test_fitting_never_opens_the_test_split(tmp_path, synthetic_set):
    shutil.rmtree(synthetic_set / "test")
    model, _ = fit(tmp_path, 3)
    assert len(model.seen["train"]) == 3
    with pytest.raises(ShardError, match=r"test/shard-00000.npz: shard is missing"):
        trainer(tmp_path).test(model, data(tmp_path))


def test_testing_visits_every_stored_cloud_as_it_is_whatever_the_seed(tmp_path, synthetic_set):
    models = [Recorder(), Recorder()]
    for seed, model in enumerate(models):
        trainer(tmp_path).test(model, data(tmp_path, seed=seed, noise_std=0.1), verbose=False)
    assert torch.cat([batch["sample"] for batch in models[0].seen["test"]]).tolist() == list(range(16))
    assert_same_batches(models[0].seen["test"], models[1].seen["test"])
    assert models[0].seen["test"][0]["dense_points"].shape == (4, 128, 3)
    noisy = Recorder()
    trainer(tmp_path).test(noisy, data(tmp_path, test_noise_std=0.1), verbose=False)
    difference = noisy.seen["test"][0]["points"] - models[0].seen["test"][0]["points"]
    assert difference.std() == pytest.approx(0.1, rel=0.1)


def test_a_limited_test_is_the_same_every_time(tmp_path, synthetic_set):
    module = data(tmp_path, max_test_samples=6)
    module.setup("test")
    samples = [torch.cat([batch["sample"] for batch in module.test_dataloader()]).tolist() for _ in range(2)]
    assert samples[0] == samples[1]
    assert [sum(i // 8 == instance for i in samples[0]) for instance in (0, 1)] == [3, 3]


def test_calibration_clouds_are_fixed_rotated_dense_training_clouds(tmp_path, synthetic_set):
    batches = [list(data(tmp_path, seed=s, noise_std=s).calibration_dataloader(6)) for s in (0, 1)]
    assert_same_batches(*batches)
    assert [len(batch["sample"]) for batch in batches[0]] == [4, 2]
    assert batches[0][0]["dense_points"].shape == (4, 128, 3)
    assert batches[0][0]["instance"].tolist() == [0, 0, 1, 1]
    assert not torch.allclose(batches[0][0]["object_rotation"][0], torch.eye(3), atol=0.1)


def test_clouds_for_discovery_are_those_of_whole_objects_if_that_is_asked_for(tmp_path):
    write_synthetic_set(tmp_path, states=6)
    module = data(tmp_path)
    whole = torch.cat([batch["instance"] for batch in module.discovery_dataloader(13, (6, 8))])
    assert whole.unique(return_counts=True)[1].sort().values.tolist() == [1, 6, 6]
    without_labels(tmp_path / "laptop" / "procedural-complete")
    module = data(tmp_path)  # which object a scan is of is no label
    assert torch.equal(torch.cat([batch["instance"] for batch in module.discovery_dataloader(13, (6, 8))]), whole)


def test_clouds_for_discovery_are_chosen_as_ever_where_objects_do_not_matter(tmp_path, synthetic_set):
    samples = torch.cat([batch["sample"] for batch in data(tmp_path).discovery_dataloader(5)])
    assert samples.tolist() == [6, 11, 8, 0, 3]


def scans_of(tmp_path: Path, *train: str, **changes) -> ArticulatedDataModule:
    """Depth views, and scans beside them whose training objects have these names; the views test test-0 and test-1."""
    write_synthetic_set(tmp_path, view="partial", protocol="honest")
    folder = write_synthetic_set(tmp_path, train_instances=len(train), test_instances=0)
    names = {"instances": {"train": train, "test": ()}, "rest_state": {one: (0.0,) for one in train}}
    replace(Manifest.load(folder), **names | changes).save(folder)
    return data(tmp_path, view="partial", scans=str(folder))


def test_scans_of_objects_that_views_test_teach_nothing(tmp_path, caplog):
    module = scans_of(tmp_path, "train-0", "test-1", "other")
    shown = torch.cat([batch["instance"] for batch in module.discovery_dataloader(100, scans=True)])
    assert set(shown.tolist()) == {0, 2}
    whole = torch.cat([batch["instance"] for batch in module.discovery_dataloader(8, (4, 4), scans=True)])
    assert whole.unique(return_counts=True)[1].tolist() == [4, 4] and 1 not in whole
    assert len(caplog.records) == 1 and "1 of 3 scanned objects" in caplog.text and "test-1" in caplog.text


@pytest.mark.parametrize("change", [{"seed": 1}, {"options": {"variant": "both_sides"}}, {"source": "urdf"}])
def test_objects_of_other_origin_only_have_the_same_names(tmp_path, change, caplog):
    module = scans_of(tmp_path, "test-0", "test-1", **change)
    shown = torch.cat([batch["instance"] for batch in module.discovery_dataloader(100, scans=True)])
    assert set(shown.tolist()) == {0, 1} and not caplog.records


def test_scans_of_nothing_but_objects_that_views_test_are_refused(tmp_path):
    with pytest.raises(ManifestError, match=r"all 2 scanned objects are in the test split of .*another SEED"):
        scans_of(tmp_path, "test-0", "test-1").discovery_dataloader(100, scans=True)


def test_scans_that_are_not_there_are_refused_whatever_reads_them(tmp_path, synthetic_set):
    with pytest.raises(ManifestError, match=r"nowhere/manifest\.json: manifest is missing"):
        data(tmp_path, scans=str(tmp_path / "nowhere")).setup("fit")
    data(tmp_path, scans=str(tmp_path / "nowhere")).setup("test")


def test_a_category_of_one_object_is_learnt_from_its_scans(tmp_path):
    module = scans_of(tmp_path, "test-0")
    replace(module.manifest, split_by="scan").save(module.folder)
    del module.manifest
    shown = torch.cat([batch["instance"] for batch in module.discovery_dataloader(100, scans=True)])
    assert set(shown.tolist()) == {0}


def test_partial_clouds_are_not_rotated(tmp_path):
    write_synthetic_set(tmp_path, view="partial", protocol="honest")
    module = data(tmp_path, view="partial", dense_in_fit=True)
    module.setup("fit")
    batch = next(iter(module.train_dataloader()))
    assert torch.equal(batch["points"], module.train_set.__getitems__(batch["sample"].tolist())["points"])
    assert batch["dense_points"].shape == (4, 128, 3)


def test_overfitting_a_batch_works(tmp_path, synthetic_set):
    model, _ = fit(tmp_path, 2, trainer_options={"overfit_batches": 1})
    assert_same_batches(model.seen["train"][:1], model.seen["train"][1:])


@pytest.mark.parametrize("world", [2, 3])
def test_ranks_share_one_training_stream_and_test_every_sample_once(tmp_path, synthetic_set, world):
    modules = [data(tmp_path, max_test_samples=13) for _ in range(world)]
    for rank, module in enumerate(modules):
        module.trainer = SimpleNamespace(world_size=world, global_rank=rank, training=True)
        module.setup("fit")
        module.setup("test")
    single, _ = fit(tmp_path, 2 * world)
    loaders = [module.train_dataloader() for module in modules]
    # Lightning replaces any other type of sampler in distributed runs.
    assert all(isinstance(loader.sampler, DistributedSampler) for loader in loaders)
    samples = [
        module.on_before_batch_transfer(next(iter(loader)), 0)["sample"]
        for _ in range(2)
        for module, loader in zip(modules, loaders, strict=True)
    ]
    together = torch.stack(samples).view(2, world, -1).mT.flatten()
    assert torch.equal(together, torch.cat([batch["sample"] for batch in single.seen["train"]]))
    assert [module.consumed_samples for module in modules] == [len(together)] * world
    tested = torch.cat([batch["sample"] for module in modules for batch in module.test_dataloader()])
    assert len(tested) == len(tested.unique()) == 13


@pytest.mark.parametrize(
    ("options", "command"),
    [
        ({}, "make data CAT=oven VIEW=complete OUT=ROOT"),
        ({"view": "partial"}, "make data CAT=oven VIEW=partial PROTOCOL=honest OUT=ROOT"),
        (
            {"view": "partial", "protocol": "eap", "source": "hoi4d"},
            "make data CAT=oven VIEW=partial PROTOCOL=eap SOURCE=hoi4d ROOT=path/to/it OUT=ROOT",
        ),
    ],
)
def test_a_missing_set_is_named_with_the_command_that_makes_it(tmp_path, options, command):
    module = ArticulatedDataModule("oven", root=str(tmp_path), **options)
    with pytest.raises(ManifestError) as error:
        module.setup("fit")
    assert str(module.folder) in str(error.value)
    assert str(error.value).endswith(command.replace("OUT=ROOT", f"OUT={tmp_path}"))


def test_a_set_of_another_category_is_refused(tmp_path, synthetic_set):
    shutil.copytree(tmp_path / "laptop", tmp_path / "safe")
    with pytest.raises(ManifestError, match=r"safe/.*manifest.json: category is 'laptop', not 'safe'"):
        ArticulatedDataModule("safe", root=str(tmp_path)).setup("fit")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size=0, must be at least 1"),
        ({"noise_std": -0.1}, "noise_std=-0.1, must be at least 0"),
        ({"max_test_samples": 0}, "max_test_samples=0"),
        ({"protocol": "eap"}, "only partial views have a protocol"),
        ({"view": "sideways"}, "view='sideways', expected one of complete, partial"),
        ({"view": "partial", "protocol": "foo"}, "protocol='foo', expected one of honest, eap"),
    ],
)
def test_senseless_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ArticulatedDataModule("laptop", **options)


def test_metrics_cannot_be_calibrated_on_a_set_without_labels(tmp_path, synthetic_set):
    without_labels(synthetic_set)
    with pytest.raises(ManifestError, match=r"has no labels.*--data\.calibration_set"):
        data(tmp_path).calibration_dataloader()
