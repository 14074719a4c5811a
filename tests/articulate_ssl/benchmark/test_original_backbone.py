"""The backbone's twin computes the same, and learns the same."""

import pytest
import torch

from articulate_ssl.benchmark.original_backbone import OriginalBackbone
from articulate_ssl.network.backbone import EquivariantBackbone


def _small_backbone():
    torch.manual_seed(0)
    return EquivariantBackbone(12, (4, 6), (0.2, 0.3), num_neighbors=10)


def test_the_original_backbone_computes_the_same():
    backbone = _small_backbone().double()
    points = 0.5 * torch.rand(2, 40, 3, dtype=torch.float64)
    torch.testing.assert_close(OriginalBackbone(backbone)(points), backbone(points), rtol=1e-9, atol=1e-9)


def test_training_with_either_backbone_follows_the_same_loss():
    curves = []
    for wrap in (lambda backbone: backbone, OriginalBackbone):
        backbone = _small_backbone()
        network = wrap(backbone)
        optimizer = torch.optim.Adam(backbone.parameters(), 1e-2)
        generator = torch.Generator().manual_seed(1)
        curve = []
        for _ in range(20):
            points = 0.5 * torch.rand(2, 30, 3, generator=generator)
            radius = points.sub(points.mean(dim=1, keepdim=True)).norm(dim=-1)
            loss = (network(points).mean(dim=(2, 3)) - radius).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            curve.append(loss.item())
        curves.append(curve)
    assert curves[0][-1] < 0.5 * curves[0][0]
    assert curves[0] == pytest.approx(curves[1], rel=1e-3)
