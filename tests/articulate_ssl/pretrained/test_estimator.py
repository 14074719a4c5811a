"""`articulate_ssl.load` and what it gives: the same prediction for every kind of cloud, and the best of several."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from synthetic import write_synthetic_set
from tiny import fit, tiny_module

import articulate_ssl
from articulate_ssl import ArticulatedPoseEstimator, ArticulatedPoseModule, ScanPrediction, load
from articulate_ssl.inference import scan_scales
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.device import DeviceError
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.pretrained.estimator import EstimatorChoice, as_cloud
from articulate_ssl.training import shipped_weights
from articulate_ssl.training.weights_card import WeightsCard
from articulate_ssl.training.weights_file import write_weights
from datamodules.point_cloud_io import PointCloudError
from datamodules.shards import read_shard


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set, a checkpoint, and weights of two categories, one of them in both views."""
    folder = tmp_path_factory.mktemp("load")
    write_synthetic_set(folder)
    module = tiny_module(steps=8, warmup_steps=6)
    fit(module, folder, 8).save_checkpoint(folder / "trained.ckpt")
    (folder / "weights").mkdir()
    for name in ("laptop-complete", "laptop-depth", "oven-complete"):
        module.hparams["category"] = name.split("-")[0]
        write_weights(module, folder / "weights" / f"{name}.safetensors")
    return folder


@pytest.fixture(autouse=True)
def package(folder, monkeypatch):
    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", folder / "weights")


@pytest.fixture(scope="module")
def cloud(folder):
    shard = read_shard(next(folder.glob("laptop/*/test/*.npz")))
    return shard["points"][0].astype(np.float64) * 40 + [5, 0, -3]


@pytest.mark.parametrize(
    ("what", "slow"),
    [
        ("import articulate_ssl; dir(articulate_ssl)", {"torch", "lightning"}),
        # To predict, Lightning and what it brings would be imported for nothing.
        ("import articulate_ssl; articulate_ssl.load('laptop-depth')", {"lightning", "torchmetrics", "matplotlib"}),
    ],
    ids=["the package", "weights"],
)
def test_what_needs_no_trainer_imports_none(what, slow) -> None:
    code = f"{what}; import sys; print({slow} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_package_offers_what_it_lists_and_nothing_else() -> None:
    for name in articulate_ssl.__all__:
        assert getattr(articulate_ssl, name).__name__ == name
        assert name in dir(articulate_ssl)
    with pytest.raises(AttributeError, match="no attribute 'laod'"):
        _ = articulate_ssl.laod


def test_arrays_tensors_and_files_are_predicted_alike(folder, cloud, tmp_path):
    estimator = load(folder / "trained.ckpt")
    np.save(tmp_path / "scan.npy", cloud)
    clouds = [cloud, torch.from_numpy(cloud), cloud.tolist(), tmp_path / "scan.npy", str(tmp_path / "scan.npy")]
    first, *others = (estimator.predict(one) for one in clouds)
    assert isinstance(first, ScanPrediction)
    for other in others:
        assert other.to_dict() == first.to_dict()
        np.testing.assert_array_equal(other.part_id, first.part_id)
    np.testing.assert_allclose(first.cloud, cloud)


def test_a_batch_goes_through_together_and_is_predicted_as_one_by_one(folder, cloud, monkeypatch):
    estimator = load(folder / "trained.ckpt")
    clouds = [cloud, cloud * 1000, cloud[:, ::-1] + np.array([0, 0, 9]), np.concatenate([cloud, cloud * 0.99])]
    alone = [estimator.predict(one) for one in clouds]
    sizes, predict = [], PoseEstimator.predict_with_rivals

    def counted(self, points, *arguments, **options):
        sizes.append(len(points) // len(scan_scales.SCALE_STARTS))
        return predict(self, points, *arguments, **options)

    monkeypatch.setattr(PoseEstimator, "predict_with_rivals", counted)
    monkeypatch.setattr(scan_scales, "_SCANS_AT_ONCE", 3)
    for batched, single in zip(estimator.predict_batch(clouds), alone, strict=True):
        # Sums of a batch round otherwise, and descent amplifies that, to .0014 radians on one processor and 2e-4 on
        # another; a point may be as near to one part as to the other.
        assert (batched.part_id == single.part_id).mean() > 0.97
        np.testing.assert_allclose(batched.states, single.states, atol=5e-3)
        np.testing.assert_allclose(batched.scale, single.scale)
        np.testing.assert_allclose(batched.reconstruction, single.reconstruction, atol=1e-3 * single.scale)
    assert sizes == [3, 1]
    assert estimator.predict_batch([]) == []


def test_the_answer_is_in_the_unit_of_the_scan(folder, cloud):
    estimator = load(folder / "trained.ckpt")
    # A power of two, which rounds nothing: descent amplifies rounding.
    small, large = estimator.predict(cloud), estimator.predict(cloud * 1024)
    np.testing.assert_allclose(large.parts[0].pose[:3, 3], small.parts[0].pose[:3, 3] * 1024, rtol=1e-3)
    assert large.relative_error == pytest.approx(small.relative_error, rel=1e-3)


def test_refinement_can_be_left_out(folder, cloud):
    estimator = load(folder / "trained.ckpt")
    default, rough = estimator.predict(cloud), estimator.predict(cloud, refine=False)
    assert default.relative_error < rough.relative_error
    assert estimator.predict(cloud, refine=True).to_dict() == default.to_dict()


@pytest.mark.parametrize(
    ("points", "problem"),
    [(np.zeros((300, 2)), "expected one cloud"), (np.zeros((5, 3)), "at least 128"), (np.zeros((300, 3)), "coincide")],
)
def test_bad_points_are_refused(folder, points, problem):
    with pytest.raises(PointCloudError, match=f"the points: .*{problem}"):
        load(folder / "trained.ckpt").predict(points)


@pytest.mark.parametrize(
    "points",
    [[[1, 2, 3], [4, 5]] * 100, torch.ones(300, 3).to_sparse(), torch.ones(300, 3, dtype=torch.complex64), None],
    ids=["ragged", "sparse", "complex", "none"],
)
def test_what_is_no_array_is_refused(points):
    with pytest.raises(PointCloudError, match=r"^the points: .*\[N, 3\]"):
        as_cloud(points)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16, torch.float32, torch.int32])
def test_tensors_of_any_numbers_are_clouds(cloud, kind):
    points = torch.from_numpy(cloud * 50).to(kind)
    np.testing.assert_array_equal(as_cloud(points), points.double())


def test_of_a_batch_the_cloud_that_is_bad_is_named(folder, cloud):
    for estimator in (load(folder / "trained.ckpt"), load("laptop")):
        with pytest.raises(PointCloudError, match=r"^clouds\[1\] of the batch: .*at least 128"):
            estimator.predict_batch([cloud, cloud[:5], cloud])


@pytest.mark.parametrize("name", ["trained.ckpt", "somebody/laptop"])
def test_a_view_of_what_does_not_come_with_the_package_is_refused(folder, name):
    with pytest.raises(CheckpointError, match=rf"{name}: view='depth' .*leave it out"):
        load(folder / name if name.endswith("ckpt") else name, view="depth")


def test_a_module_is_saved_with_its_card(folder, tmp_path):
    (tmp_path / "oven.safetensors").write_bytes((folder / "weights" / "oven-complete.safetensors").read_bytes())
    data = {"command": "make data", "seed": 1, "train_instances": 3, "test_instances": 2}
    training = {"command": "lightning fit", "seed": 0, "steps": 8, "commit": "abc"}
    tested = {"samples": 16, "instances": 2}
    card = WeightsCard("oven", "complete", ["body", "door"], data, training, tested, ["none"], "2026-01-02")
    card.save(tmp_path / "oven.json")
    ArticulatedPoseModule.from_pretrained(tmp_path / "oven.safetensors").save_pretrained(tmp_path / "mine")
    assert load(tmp_path / "mine").card == card


@pytest.mark.parametrize("device", ["foo", "cuda:99", "hpu", "meta"])
def test_a_device_that_cannot_compute_is_refused(folder, device):
    estimator = load("laptop")
    for ask in (lambda: load("laptop", device=device), lambda: estimator.to(device)):
        with pytest.raises(DeviceError, match=rf"'{device}' is no device .*use cpu"):
            ask()
    assert estimator.device == torch.device("cpu")


def test_names_lead_to_one_or_several_sets_of_weights(folder):
    assert load("oven").weights == "oven-complete"
    assert load("laptop", view="depth").weights == "laptop-depth"
    assert load("laptop-depth").category == "laptop"
    both = load("laptop")
    assert isinstance(both, EstimatorChoice) and both.category == "laptop"
    assert [estimator.weights for estimator in both.estimators] == ["laptop-complete", "laptop-depth"]
    assert len(load("auto").estimators) == 3 and load("auto").category == "auto"
    assert [estimator.weights for estimator in load("auto", view="depth").estimators] == ["laptop-depth"]
    path = folder / "trained.ckpt"
    assert load(path).weights == str(path) and load(path).estimators[0].card is None


def test_of_several_the_one_that_explains_the_scan_best_answers(folder, cloud):
    choice = load("auto")
    ignorant, *_ = choice.estimators
    with torch.no_grad():
        ignorant.module.articulated.category.template.mul_(5)  # far too large for any scan
    found = choice.compare(cloud)
    assert [result.checkpoint for result in found][-1] == ignorant.weights
    assert choice.predict(cloud).to_dict() == found[0].to_dict()
    assert choice.predict(cloud).checkpoint == found[0].checkpoint != ignorant.weights
    assert [result.checkpoint for result in choice.predict_batch([cloud] * 2)] == [found[0].checkpoint] * 2


def test_estimators_move_to_devices(folder):
    choice = load("auto").to("cpu")
    assert choice.device == torch.device("cpu") == choice.estimators[-1].device
    assert "oven-complete on cpu" in repr(choice) and "trained.ckpt on cpu" in repr(load(folder / "trained.ckpt"))


def test_without_any_weights_the_error_says_how_to_make_them(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", tmp_path)
    with pytest.raises(CheckpointError, match="make weights"):
        load("auto")
    with pytest.raises(CheckpointError, match=r"laptop: neither a file nor .*make weights"):
        load("laptop")


def test_a_module_in_memory_is_an_estimator_too(folder, cloud):
    module = ArticulatedPoseModule.from_pretrained(folder / "trained.ckpt")
    direct = ArticulatedPoseEstimator(module, "in memory").predict(cloud)
    assert direct.checkpoint == "in memory"
    np.testing.assert_array_equal(direct.part_id, load(folder / "trained.ckpt").predict(cloud).part_id)
