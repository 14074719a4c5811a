"""Registration is believed as far as `inference.most_turned` says, hypothesis by hypothesis."""

from dataclasses import replace

import pytest
import roma
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions

OPTIONS = InferenceOptions(refine=True, candidates=12)


def _candidates(options: InferenceOptions, registers: bool):
    module = tiny_module(inference=options).eval()
    clouds = torch.rand(5, POINTS, 3, generator=torch.Generator().manual_seed(6)) - 0.5
    with torch.no_grad():
        found = module.estimator._candidates(clouds, POINTS, registers)
        every = [found.select(torch.full((5,), index)) for index in range(found.error.shape[1])]
    poses = torch.stack([one.object_pose()[:, 0] for one in every], dim=1)  # [B, C, K, 4, 4]
    order = found.error.argsort(dim=1) if not registers else None
    return poses, found.error, order


def _degrees(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return roma.rotmat_geodesic_distance(one[..., :3, :3], other[..., :3, :3]).rad2deg()


@pytest.fixture(scope="module")
def raw() -> torch.Tensor:
    """[B, C, K, 4, 4] what the network says, best first, as registration starts from it."""
    poses, _, order = _candidates(OPTIONS, registers=False)
    return poses[torch.arange(5)[:, None], order]


@pytest.fixture(scope="module")
def registered() -> tuple[torch.Tensor, torch.Tensor]:
    """Poses and errors without a limit."""
    return _candidates(OPTIONS, registers=True)[:2]


@pytest.mark.parametrize("limit", [0.0, 15.0, 60.0])
def test_what_is_turned_further_stays_as_the_network_has_it(raw, registered, limit):
    poses, error = registered
    found, own, _ = _candidates(replace(OPTIONS, most_turned=limit), registers=True)
    far = _degrees(raw, poses).amax(dim=-1) > limit
    if limit == 15:
        assert far.any() and not far.all()  # else this test would say nothing
    torch.testing.assert_close(found, torch.where(far[..., None, None, None], raw, poses), atol=1e-4, rtol=0)
    torch.testing.assert_close(own[~far], error[~far])
    assert not torch.equal(own[far], error[far]) or not far.any()  # errors are those of the poses that stay


def test_half_a_turn_is_no_limit(registered):
    found, error, _ = _candidates(replace(OPTIONS, most_turned=180.0), registers=True)
    torch.testing.assert_close(found, registered[0])
    torch.testing.assert_close(error, registered[1])
