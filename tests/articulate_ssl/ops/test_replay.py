"""Recordings on a GPU: when there is one, and that nothing in it needs the host. There is no GPU here."""

from __future__ import annotations

import pytest
import torch
from pretended_gpu import pretended_gpu, pretended_recording
from tiny import POINTS, tiny_module

from articulate_ssl.inference.upright_camera import FEWEST
from articulate_ssl.ops import replay
from articulate_ssl.ops.replay import Replay
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER


@pytest.fixture
def recordings(monkeypatch):
    """Shapes of clouds that were recorded; what is recorded must not ask the host, and is called again and again."""
    shapes = []

    def recorded(function, points):
        shapes.append(tuple(points.shape))

        def replayed(clouds):
            with pretended_recording():
                return function(clouds)

        return replayed

    monkeypatch.setattr(replay, "recorded", recorded)
    with pretended_gpu():
        yield shapes


@pytest.fixture
def twice():
    weight = torch.ones(3)
    return Replay(lambda: [weight], torch.clone), weight


def _sum(clouds):
    return clouds.sum(dim=1)


@torch.no_grad()
def test_what_is_asked_twice_is_recorded_once(recordings, twice):
    run, points = twice[0], torch.rand(1, 5, 3).to("cuda")
    answers = [run(_sum, points + k, "how") for k in range(4)]
    assert recordings == [(1, 5, 3)]
    for k, answer in enumerate(answers):
        torch.testing.assert_close(answer, _sum(points + k))


@torch.no_grad()
def test_what_differs_is_not_replayed(recordings, twice):
    run, weight = twice
    points = torch.rand(1, 5, 3).to("cuda")
    for _ in range(3):
        run(_sum, points, "how")
    for change in (lambda: (points[:, :4], "how"), lambda: (points, "otherwise"), lambda: (points.double(), "how")):
        before = len(recordings)
        run(_sum, *change())
        assert len(recordings) == before
        run(_sum, *change())
        assert len(recordings) == before + 1
    weight.data = torch.ones(3)
    before = len(recordings)
    for _ in range(2):
        run(_sum, points, "how")
    assert len(recordings) == before + 1


@torch.no_grad()
def test_few_recordings_are_kept(recordings, twice):
    run, count = twice[0], replay._MOST_RECORDINGS + 1
    for number in range(count):
        for _ in range(2):
            run(_sum, torch.rand(1, 2 + number, 3).to("cuda"), "how")
    assert len(run._recordings) == replay._MOST_RECORDINGS and len(recordings) == count


def test_nothing_else_is_recorded(recordings, twice):
    run, points = twice[0], torch.rand(1, 5, 3).to("cuda")
    for _ in range(3):
        run(_sum, points, "how")  # with gradients
    with torch.no_grad():
        for _ in range(3):
            run(_sum, torch.rand(1, 5, 3), "how")  # on the CPU
            run(_sum, points.expand(replay._MOST_CLOUDS + 1, -1, -1), "how")
    assert recordings == []


@pytest.mark.parametrize("sought", [lambda x: x.sum().item(), lambda x: x[x > 0], lambda x: x[[0]], lambda x: x.cpu()])
def test_the_pretence_refuses_what_a_recording_refuses(sought):
    with pretended_gpu():
        there = torch.ones(3).to("cuda")
        with pretended_recording(), pytest.raises(RuntimeError, match="in a recording"):
            sought(there)
        with pretended_recording(), pytest.raises(RuntimeError, match="in a recording"):
            torch.ones(2).to(there)
        with pretended_recording():
            assert there[1:].device.type == "cuda" and float(torch.ones(())) == 1


@pytest.mark.parametrize("recipe", ["paper", "staged"])
def test_proposals_of_the_networks_are_recorded(recordings, recipe):
    module = tiny_module(recipe=recipe).eval()
    module.num_points = POINTS
    clouds = [torch.rand(1, POINTS, 3) for _ in range(3)]
    expected = [module.predict_points(cloud, refine=False).part_pose for cloud in clouds]
    module.to("cuda")
    for cloud, pose in zip(clouds, expected, strict=True):
        found = module.predict_points(cloud.to("cuda"), refine=False).to("cpu")
        torch.testing.assert_close(found.part_pose, pose, atol=1e-4, rtol=0)
    assert recordings == [(1, POINTS, 3)]


def test_where_it_is_known_which_way_is_up_nothing_is_recorded(recordings):
    module = tiny_module().eval()
    module.num_points = POINTS
    camera = module.estimator.hinge_sides.camera
    camera.learn(torch.eye(3).expand(FEWEST, 3, 3), torch.eye(3))
    assert camera.learnt
    for _ in range(3):
        module.to("cuda").predict_points(torch.rand(1, POINTS, 3).to("cuda"), refine=False)
    assert recordings == []


@pytest.mark.parametrize("name", ["laptop-complete", "drawer-complete", "eyeglasses-depth"])
def test_proposals_of_shipped_weights_need_no_host(recordings, name):
    module = load_module(WEIGHTS_FOLDER / f"{name}.safetensors").to("cuda")
    for seed in range(3):
        cloud = torch.rand(1, module.num_points, 3, generator=torch.Generator().manual_seed(seed)) - 0.5
        module.predict_points(cloud.to("cuda"), refine=False)
    assert recordings == [(1, module.num_points, 3)]
