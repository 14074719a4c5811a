"""Rotating a cloud permutes the hypotheses and turns their poses; shape and structure stay."""

from operator import attrgetter
from types import SimpleNamespace

import pytest
import roma
import torch

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.losses.objective import ObjectiveOptions, paper_terms
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.options import NetworkOptions

TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
INVARIANT = ("part_shape", "assembly", "pivot", "structure.confidence", "structure.pair_pivot", "association_logits")
PER_HYPOTHESIS = ("axis", "state", "structure.pair_axis")


def _quantity(hypotheses, name) -> torch.Tensor:
    return attrgetter(name)(hypotheses)


def _network(
    num_parts=3, order=12, dtype=torch.float32, num_centers=(24, 16), joint_type=REVOLUTE, **options
) -> ArticulatedNetwork:
    torch.manual_seed(0)
    sizes = NetworkOptions(
        group_order=order,
        dims=[4, 8],
        radii=[0.3, 0.5],
        num_neighbors=10,
        num_kernel_points=13,
        num_centers=list(num_centers),
        head_dim=12,
        shape_points=5,
        **{"shared_axis": False} | options,
    )
    network = ArticulatedNetwork(sizes, num_parts, joint_type)
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
            worst = max(worst, *(_error(_quantity(after, n)[:, to], _quantity(before, n)) for n in PER_HYPOTHESIS))
            worst = max(worst, *(_error(_quantity(after, n), _quantity(before, n)) for n in INVARIANT))
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_features_on_directions_give_equivariant_hypotheses(dtype):
    network = _network(order=60, dtype=dtype, directions=True)
    assert _rotation_error(network, _cloud(dtype)) < TOLERANCE[dtype]
    assert network(_cloud(dtype)).state.std(dim=1).min() > 1e-3


@pytest.mark.parametrize("pool", ["part_pool", "point_pool"])
def test_a_pooling_that_prefers_an_anchor_is_found_out(pool):
    network = _network()
    getattr(network, pool).forward = lambda features: features[..., 0, :]
    assert _rotation_error(network, _cloud(), elements=[1, 5]) > 1e-2


@pytest.mark.parametrize("head", ["pose_head.joint_state", "axis_head.forward", "pose_head.base_pose"])
def test_a_head_that_reads_one_anchor_only_is_found_out(head):
    network = _network()
    name, method = head.split(".")
    module = getattr(network, name)
    original = getattr(module, method)
    setattr(module, method, lambda x, *rest: original(x[:, :, :1].expand_as(x), *rest))
    assert _rotation_error(network, _cloud(), elements=[1, 5]) > 1e-2


def _translation_error(network, points) -> float:
    shift = torch.tensor([2.0, -1.0, 3.0]).to(points)
    with torch.no_grad():
        before, after = network(points), network(points + shift)
    moved = before.base.clone()
    moved[..., :3, 3] += shift
    errors = [_error(after.base, moved)]
    return max(errors + [_error(_quantity(after, n), _quantity(before, n)) for n in INVARIANT + PER_HYPOTHESIS])


def test_translation_moves_the_base_and_nothing_else():
    assert _translation_error(_network(), _cloud()) < 1e-4
    assert _translation_error(_network(dtype=torch.float64), _cloud(torch.float64)) < 1e-9


def test_absolute_coordinates_are_found_out():
    network = _network()
    network.backbone.register_forward_pre_hook(lambda module, args: setattr(network, "seen", args[0]))
    pool = network.pointnet.forward
    network.pointnet.forward = lambda features, centers, w: pool(features, network.seen[:, : centers.shape[1]], w)
    assert _translation_error(network, _cloud()) > 1e-2


def _order_error(network, points) -> float:
    """Largest relative violation when points change places within what each layer keeps."""
    beyond = torch.cat([torch.arange(24), 24 + torch.randperm(8)])
    within = torch.cat([torch.randperm(16), 16 + torch.randperm(8), 24 + torch.arange(8)])
    worst = 0.0
    with torch.no_grad():
        before = network(points)
        for order in (beyond, within):
            after = network(points[:, order])
            for name in (*INVARIANT, *PER_HYPOTHESIS, "base"):
                expected = _quantity(before, name)
                expected = expected[:, order[:16]] if name == "association_logits" else expected
                worst = max(worst, _error(_quantity(after, name), expected))
    return worst


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_order_of_points_beyond_the_centres_does_not_matter(dtype):
    assert _order_error(_network(dtype=dtype), _cloud(dtype)) < TOLERANCE[dtype]


def test_a_layer_that_knows_the_places_of_points_is_found_out():
    network = _network()
    network.backbone.register_forward_hook(
        lambda module, args, out: out * torch.linspace(0.5, 2, out.shape[1])[:, None, None]
    )
    assert _order_error(network, _cloud()) > 1e-2


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
        assert _error(_quantity(after, name), _quantity(before, name)) < TOLERANCE[dtype], name
    assert _error(after.base, motion[:, None, 0] @ before.base) < TOLERANCE[dtype]
    assert _error(wrong.association_logits, before.association_logits) > 1e-3


def test_a_cloud_does_not_depend_on_the_rest_of_its_batch():
    network, points = _network(), _cloud()
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float64, 1e-12)):
        with torch.no_grad():
            together, alone = (network.to(dtype)(cloud.to(dtype)) for cloud in (points, points[:1]))
        for name in (*INVARIANT, *PER_HYPOTHESIS, "base"):
            assert _error(_quantity(together, name)[:1], _quantity(alone, name)) < tolerance, name


def _assert_finite(network, points) -> None:
    """Predictions and gradients of the paper's objective."""
    out = network(points)
    assert out.posed().isfinite().all()
    paper_terms(out.select(torch.zeros(len(points), dtype=torch.long)), points, ObjectiveOptions()).loss.backward()
    assert all(p.grad.isfinite().all() for p in network.parameters() if p.grad is not None)


def test_coincident_points_are_free_of_nan():
    _assert_finite(_network(), torch.zeros(1, 32, 3))


def test_zero_angles_are_free_of_nan():
    network = _network()
    for heads in (network.pose_head.base, network.pose_head.state, network.axis_head.perceptron):
        for head in heads:
            torch.nn.init.zeros_(head[-1].weight)
            torch.nn.init.zeros_(head[-1].bias)
    assert (network(_cloud()).state == 0).all()
    _assert_finite(network, _cloud())
    assert all(
        head[-1].weight.grad.abs().max() > 0
        for k in network.category.chain().child
        for head in [network.pose_head.state[k]]
    )


@pytest.mark.parametrize("points_of_slots", [(16, 0, 0), (15, 1, 0), (14, 1, 1)], ids=str)
def test_empty_slots_and_parts_of_one_point_are_free_of_nan(points_of_slots):
    network = _network()
    slot = torch.repeat_interleave(torch.arange(3), torch.tensor(points_of_slots))
    certain = 1e4 * torch.nn.functional.one_hot(slot, 3) - 1e4  # whose softmax is exactly 0 and 1
    proposal = network.part_proposal.forward
    network.part_proposal.forward = lambda features: proposal(features) + certain
    association = network(_cloud()).association_logits.softmax(dim=-1)
    assert association.sum(dim=1)[0].tolist() == list(points_of_slots)
    _assert_finite(network, _cloud())


def test_unknown_joint_types_are_refused():
    with pytest.raises(ValueError, match="joint_type"):
        _network(joint_type=7)
