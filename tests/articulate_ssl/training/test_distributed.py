"""Two processes on the CPU train what one with twice the batch trains: curve, parameters, and what is remembered."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Callback
from lightning.pytorch.plugins.environments import LightningEnvironment
from synthetic import write_synthetic_set
from tiny import POINTS, quiet_trainer, tiny_data, tiny_module
from torch import distributed
from torch import multiprocessing as mp
from torch.distributed.algorithms.ddp_comm_hooks.debugging_hooks import noop_hook

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.ops.ranks import of_all_ranks, own_rows
from articulate_ssl.training.module import ArticulatedPoseModule

BATCH = 4  # of one process; the other holds as many
STEPS = 4  # in passes of two steps over the set's 12 clouds
RECIPES = {
    "paper": {"recipe": "paper"},
    # A step of stage 0, two of warm-up, one of self-supervision.
    "staged": {"recipe": "staged", "rigid_steps": 1, "warmup_steps": 2, "network": {"iterations": 1}},
}
# Adam makes steps of rounding where a gradient is zero: parameters differ by 1e-5 then, gradients that are not averaged
# make it 1e-2. Curves differ by 1e-7 of their values, or by 1e-3.
SAME = {"rtol": 0, "atol": 1e-4}
SAME_CURVE = {"rel": 1e-5, "abs": 1e-6}


class Recorder(Callback):
    """Keeps what is logged in every step; can keep gradients from being averaged."""

    def __init__(self, averages: bool) -> None:
        self.averages, self.curve = averages, []

    def on_train_start(self, trainer, pl_module) -> None:
        if not self.averages:
            trainer.strategy.model.register_comm_hook(None, noop_hook)

    def on_train_batch_end(self, trainer, *_) -> None:
        self.curve.append({name: float(value) for name, value in trainer.callback_metrics.items()})


def find_something(module: ArticulatedPoseModule, rank: int) -> None:
    """In place of discovery, which would take longer than all else; no two ranks find the same."""
    generator, category = torch.Generator().manual_seed(rank), module.articulated.category
    category.template.data.copy_(0.1 * torch.randn(category.template.shape, generator=generator))
    found = {
        "points": 0.3 * torch.randn(6, POINTS, 3, generator=generator),
        "base": torch.eye(4).repeat(6, 1, 1),
        "state": torch.rand(6, 1, generator=generator),
        "log_stretch": torch.zeros(6, 2, 3),
        "limits": torch.tensor([[0.0, 1.0]]),
    }
    module.sliding.gallery = torch.randn(3, *module.sliding.gallery.shape[1:], generator=generator)
    module.recipe.restore(found)


def find_nothing(_, rank: int) -> None:
    raise DiscoveryError(f"rank {rank} found nothing")


def train(
    root: Path, rank: int, batch_size: int, recipe: str, averages: bool = True, find=find_something, **trainer_options
) -> dict:
    """What was logged in every step, and the module's state after the last."""
    module, recorder = tiny_module(STEPS, calibration_samples=0, **RECIPES[recipe]), Recorder(averages)
    module.recipe.prepare = lambda *_: find(module, rank)
    trainer = quiet_trainer(root, max_steps=STEPS, callbacks=[recorder], **trainer_options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(module, tiny_data(root, batch_size=batch_size))
    return {"curve": recorder.curve, "state": module.state_dict()}


def one_of_two(rank: int, root: Path) -> None:
    """Everything that rank 0 or 1 does, by the strategy of configs/profiles/gpu.yaml."""
    torch.set_num_threads(1)
    os.environ["LOCAL_RANK"] = str(rank)
    distributed.init_process_group("gloo", init_method=f"file://{root}/store", rank=rank, world_size=2)
    together = {"devices": 2, "strategy": "ddp_find_unused_parameters_true", "plugins": [LightningEnvironment()]}
    runs = {recipe: train(root, rank, BATCH, recipe, **together) for recipe in RECIPES}
    runs["not averaged"] = train(root, rank, BATCH, "paper", averages=False, **together)
    with pytest.raises(DiscoveryError) as raised:
        train(root, rank, BATCH, "staged", find=find_nothing, **together)
    runs["nothing found"] = str(raised.value)
    rows = torch.arange(2 * BATCH).view(-1, 1)
    runs["rows"] = own_rows(rows), of_all_ranks(own_rows(rows))
    torch.save(runs, root / f"{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> list[dict]:
    """Of rank 0, of rank 1, and of one process with twice the batch."""
    root = tmp_path_factory.mktemp("distributed")
    write_synthetic_set(root)
    # Not forked: torch forbids that after a backward pass where there is a GPU.
    ranks = mp.start_processes(one_of_two, args=(root,), nprocs=2, join=False, daemon=True, start_method="spawn")
    one = {recipe: train(root, 0, 2 * BATCH, recipe) for recipe in RECIPES}
    while not ranks.join():
        pass
    return [*(torch.load(root / f"{rank}.pt", weights_only=True) for rank in range(2)), one]


def assert_same_curve(left: list[dict], right: list[dict]) -> None:
    assert len(left) == len(right) == STEPS
    for step, (a, b) in enumerate(zip(left, right, strict=True)):
        assert a == pytest.approx(b, **SAME_CURVE), f"step {step}"


@pytest.mark.parametrize("recipe", RECIPES)
def test_two_processes_train_what_one_with_twice_the_batch_trains(runs, recipe):
    first, second, one = (run[recipe] for run in runs)
    assert_same_curve(first["curve"], one["curve"])
    assert_same_curve(second["curve"], one["curve"])
    for name, value in one["state"].items():
        torch.testing.assert_close(first["state"][name], value, **SAME, msg=lambda text: f"{name}: {text}")  # noqa: B023
        assert torch.equal(first["state"][name], second["state"][name]), name


def test_gradients_that_are_not_averaged_are_found_out(runs):
    first, second, _ = (run.get("not averaged") for run in runs)
    one = runs[2]["paper"]
    assert first["curve"][0] == pytest.approx(one["curve"][0], **SAME_CURVE)
    with pytest.raises(AssertionError, match="step 1"):
        assert_same_curve(first["curve"], one["curve"])
    name = "articulated.category.template"
    for other in (second, one):
        with pytest.raises(AssertionError):
            torch.testing.assert_close(first["state"][name], other["state"][name], **SAME)


def test_all_ranks_are_told_that_nothing_was_found(runs):
    assert [run.get("nothing found") for run in runs[:2]] == ["rank 0 found nothing"] * 2


def test_every_second_cloud_is_one_ranks_and_all_come_back_in_order(runs):
    for rank in range(2):
        own, everything = runs[rank]["rows"]
        assert own.flatten().tolist() == list(range(rank, 2 * BATCH, 2))
        assert everything.flatten().tolist() == list(range(2 * BATCH))


def test_one_process_gets_back_what_it_gave():
    rows = torch.rand(3, 2)
    assert torch.equal(of_all_ranks(rows), rows) and torch.equal(own_rows(rows), rows)
