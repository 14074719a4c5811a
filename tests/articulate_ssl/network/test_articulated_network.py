"""Rotating a cloud permutes the hypotheses and turns their poses; shape and structure stay."""

from types import SimpleNamespace

import pytest
import roma
import torch

from articulate_ssl.groups import rotation_group
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.backbone import EquivariantBackbone
from datamodules.geometry import PRISMATIC, REVOLUTE, se3, transform_points

TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
INVARIANT = ("part_shape", "assembly", "pivot", "confidence", "pair_pivot", "association_logits")
PER_HYPOTHESIS = ("axis", "state", "pair_axis")


def _network(num_parts=3, order=12, dtype=torch.float32, num_centers=(24, 16), **options) -> ArticulatedNetwork:
    torch.manual_seed(0)
    backbone = EquivariantBackbone(order, (4, 8), (0.3, 0.5), 10, 13, num_centers)
    network = ArticulatedNetwork(backbone, rotation_group(order), 8, 6, num_parts, 5, **options)
    for parameter in network.parameters():  # untrained heads say almost nothing
        torch.nn.init.normal_(parameter, std=0.4)
    return network.to(dtype).eval()


def _cloud(dtype=torch.float32, points=32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(2, points, 3, generator=generator, dtype=torch.float64).to(dtype) - 0.3


def _error(value, expected) -> float:
    return ((value - expected).norm() / expected.norm()).item()


def _rotation_error(network, points, elements=None) -> float:
    """Largest relative violation, over group elements and quantities, of the equivariance of all hypotheses."""
    group, worst = network.backbone.group, 0.0
    with torch.no_grad():
        before = network(points)
        posed = before.posed()
        for a in elements or range(len(group)):
            rotation = group.elements[a].to(points)
            after = network(points @ rotation.T)
            to = group.product[a]  # hypothesis g becomes hypothesis product[a, g]
            worst = max(worst, _error(after.posed()[:, to], posed @ rotation.T))
            turned = se3(rotation, torch.zeros(3).to(points)) @ before.base
            worst = max(worst, _error(after.base[:, to], turned))
            worst = max(worst, *(_error(getattr(after, n)[:, to], getattr(before, n)) for n in PER_HYPOTHESIS))
            worst = max(worst, *(_error(getattr(after, n), getattr(before, n)) for n in INVARIANT))
    return worst


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_rotation_permutes_hypotheses_and_turns_their_poses(joint_type, dtype):
    network = _network(dtype=dtype, joint_type=joint_type)
    assert _rotation_error(network, _cloud(dtype)) < TOLERANCE[dtype]
    out = network(_cloud(dtype))
    assert out.state.std(dim=1).min() > 1e-3  # hypotheses differ, or the test above says nothing
    assert out.part_shape.dtype == out.base.dtype == dtype


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("order", [24, 60])
def test_larger_groups_are_as_exact(order, dtype):
    network = _network(num_parts=2, order=order, dtype=dtype, part_features=False, shared_axis=True)
    assert _rotation_error(network, _cloud(dtype), elements=[1, order // 2, order - 1]) < TOLERANCE[dtype]


@pytest.mark.parametrize("head", ["_states", "_axes", "_base"])
def test_a_head_that_reads_one_anchor_only_is_found_out(head):
    network = _network()
    original = getattr(network, head)
    setattr(network, head, lambda x, *rest: original(x[:, :, :1].expand_as(x), *rest))
    assert _rotation_error(network, _cloud(), elements=[1, 5]) > 1e-2


def _translation_error(network, points) -> float:
    shift = torch.tensor([2.0, -1.0, 3.0]).to(points)
    with torch.no_grad():
        before, after = network(points), network(points + shift)
    moved = before.base.clone()
    moved[..., :3, 3] += shift
    errors = [_error(after.base, moved)]
    return max(errors + [_error(getattr(after, n), getattr(before, n)) for n in INVARIANT + PER_HYPOTHESIS])


def test_translation_moves_the_base_and_nothing_else():
    assert _translation_error(_network(), _cloud()) < 1e-4
    assert _translation_error(_network(dtype=torch.float64), _cloud(torch.float64)) < 1e-9


def test_absolute_coordinates_are_found_out():
    network = _network()
    network.backbone.register_forward_pre_hook(lambda module, args: setattr(network, "seen", args[0]))
    pool = network.pointnet.forward
    network.pointnet.forward = lambda features, centers, w: pool(features, network.seen[:, : centers.shape[1]], w)
    assert _translation_error(network, _cloud()) > 1e-2


def test_the_order_of_points_beyond_the_centres_does_not_matter():
    network, points = _network(dtype=torch.float64), _cloud(torch.float64)
    order = torch.cat([torch.arange(24), 24 + torch.randperm(8)])
    within = torch.cat([torch.randperm(16), 16 + torch.randperm(8), 24 + torch.arange(8)])
    with torch.no_grad():
        before, beyond, inside = network(points), network(points[:, order]), network(points[:, within])
    for name in (*INVARIANT, *PER_HYPOTHESIS, "base"):
        assert _error(getattr(beyond, name), getattr(before, name)) < 1e-9, name
        expected = getattr(before, name)
        expected = expected[:, within[:16]] if name == "association_logits" else expected
        assert _error(getattr(inside, name), expected) < 1e-9, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_parts_moved_with_their_given_poses_leave_everything_but_the_base_unchanged(dtype):
    network, points = _network(dtype=dtype), _cloud(dtype)
    labels = torch.randint(3, points.shape[:2], generator=torch.Generator().manual_seed(2))
    torch.manual_seed(3)
    pose, motion = (se3(roma.random_rotmat((2, 3), dtype=dtype), torch.randn(2, 3, 3, dtype=dtype)) for _ in range(2))
    rows = torch.arange(2)[:, None]
    moved = transform_points(motion[rows, labels], points[:, :, None])[:, :, 0]

    def run(points, pose):
        # The root's pose is the base; any pose of the other parts, not only those that its joints can reach.
        estimate = SimpleNamespace(object_pose=lambda: pose[:, None], base=pose[:, None, 0], state=torch.zeros(2, 1, 2))
        return network(points, estimate, labels)

    with torch.no_grad():
        before, after = run(points, pose), run(moved, motion @ pose)
        wrong = run(moved, pose)
    for name in INVARIANT + PER_HYPOTHESIS:
        assert _error(getattr(after, name), getattr(before, name)) < TOLERANCE[dtype], name
    assert _error(after.base, motion[:, None, 0] @ before.base) < TOLERANCE[dtype]
    assert _error(wrong.association_logits, before.association_logits) > 1e-3


def test_a_cloud_does_not_depend_on_the_rest_of_its_batch():
    network, points = _network(), _cloud()
    with torch.no_grad():
        together, alone = network(points), network(points[:1])
    for name in (*INVARIANT, *PER_HYPOTHESIS, "base"):
        torch.testing.assert_close(getattr(together, name)[:1], getattr(alone, name), rtol=1e-5, atol=1e-6)


def test_coincident_points_are_free_of_nan():
    network = _network()
    out = network(torch.zeros(1, 32, 3))
    out.posed().sum().backward()
    assert out.posed().isfinite().all()
    assert all(p.grad.isfinite().all() for p in network.parameters() if p.grad is not None)


def test_unknown_joint_types_are_refused():
    with pytest.raises(ValueError, match="joint_type"):
        _network(joint_type=7)
