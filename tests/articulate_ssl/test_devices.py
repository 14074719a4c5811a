"""Nothing mixes tensors of a GPU with the CPU's: seen where there is no GPU (`pretended_gpu`)."""

from __future__ import annotations

import pytest
import torch
from pretended_gpu import pretended_gpu
from tiny import POINTS, tiny_module

from articulate_ssl.ops.spin_images import spin_images
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER

SHIPPED = ("drawer-complete", "drawer-depth", "laptop-complete", "safe-complete", "safe-depth")
LEARNT = (
    *("two_ways", "sliding", "view_search", "handedness", "hinge_sides"),
    *("part_frames", "common_shape", "object_frame", "front_ends"),
)


def test_the_pretence_refuses_what_a_gpu_refuses():
    with pretended_gpu():
        there, here = torch.rand(3, 4).to("cuda"), torch.rand(3, 4)
        assert (there.device.type, here.device.type, there.cpu().device.type) == ("cuda", "cpu", "cpu")
        assert {x.device.type for x in (there[:1], there.mT @ there, torch.zeros(2, device=there.device))} == {"cuda"}
        layer = torch.nn.Linear(4, 2).to("cuda")
        assert layer(there).device.type == "cuda"
        torch.testing.assert_close(there.cpu() * 2, (there * 2).cpu())
        for fails in (lambda: there + here, lambda: layer(here), lambda: torch.cat([here, there])):
            with pytest.raises(RuntimeError, match="tensors on cuda:0 and cpu"):
                fails()
        with pytest.raises(TypeError, match="to numpy"):
            there.numpy()
    assert there.device.type == "cpu"


def test_surfaces_of_many_clouds():
    clouds = torch.rand(65, 1024, 3, generator=torch.Generator().manual_seed(0))
    with pretended_gpu():
        there = clouds.to("cuda")
        with pytest.raises(RuntimeError, match="cusolver"):
            torch.linalg.eigh(torch.eye(3, device=there.device).expand(2**16, -1, -1))
        images, normal = spin_images(there, there)
    expected = spin_images(clouds, clouds)
    torch.testing.assert_close((images, normal), expected, atol=2e-3, rtol=0)


@pytest.mark.parametrize("recipe", ["paper", "staged"])
def test_predictions_of_a_new_module(recipe):
    module, points = tiny_module(recipe=recipe).eval(), torch.rand(2, POINTS, 3)
    module.num_points = POINTS
    expected = module.predict_points(points, refine=False)
    with pretended_gpu():
        found = module.to("cuda").predict_points(points.to("cuda"), refine=False).to("cpu")
    torch.testing.assert_close(found.part_pose, expected.part_pose, atol=1e-4, rtol=0)


def test_between_them_they_have_learnt_everything_that_decides():
    learnt = set()
    for name in SHIPPED:
        estimator = load_module(WEIGHTS_FOLDER / f"{name}.safetensors").estimator
        learnt |= {part for part in LEARNT if getattr(estimator, part).learnt}
        learnt |= {"surface"} if estimator.object_frame.surface is not None else set()
        learnt |= {"parts"} if estimator.view_search.parts is not None else set()
    assert learnt == {*LEARNT, "surface", "parts"}


@pytest.mark.parametrize("name", SHIPPED)
def test_predictions_of_shipped_weights(name):
    module = load_module(WEIGHTS_FOLDER / f"{name}.safetensors")
    generator = torch.Generator().manual_seed(0)
    dense = 0.5 * torch.rand(1, 4096, 3, generator=generator) * torch.tensor([0.8, 1.0, 0.6])
    dense -= dense.mean(dim=1, keepdim=True)
    with pretended_gpu():
        module.to("cuda")
        cloud = dense.to("cuda")
        found = module.predict_points(cloud[:, : module.num_points], True, cloud)
        assert found.part_pose.device.type == "cuda"
        found = found.to("cpu")
    assert torch.isfinite(found.part_pose).all() and found.dense_part_id.shape == (1, 4096)
