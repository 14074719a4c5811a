import pytest
import roma
import torch
from synthetic import write_synthetic_set

from articulate_ssl.baselines.method import Effort, Problem
from articulate_ssl.baselines.npcs import NPCSEPN, Target, distinct
from articulate_ssl.baselines.npcs import NPCSKPConv as KPConv
from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.metrics.articulated_pose import cloud_errors
from articulate_ssl.metrics.calibration import calibrate
from articulate_ssl.network.backbone import GroupConvolutionBlock
from articulate_ssl.network.coordinate_network import WholeShape
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.ops.neighborhood import correlate, nearest_neighbors
from articulate_ssl.ops.spin_images import spin_images
from datamodules.articulated_dataset import ArticulatedDataset

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


def some(folder, count=4, num_points=64):
    return ArticulatedDataset(folder, "train", num_points=num_points).__getitems__(list(range(count)))


def make(kind, joint_type=REVOLUTE, seed=0, num_parts=2):
    torch.manual_seed(seed)
    method = kind(Problem(num_parts, joint_type, 1.5, 64), TINY)
    method.log = lambda name, value: None
    return method


def turned(labels, rotation):
    return {name: labels[name] @ rotation.T for name in ("points", "dense_points")}


def chain_of_three(joint_type):
    """Labels of six clouds of three parts, each hinged to the one before."""
    generator = torch.Generator().manual_seed(0)
    clouds, axis = 6, torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    pivot, state = torch.randn(2, 3, generator=generator), torch.rand(clouds, 2, generator=generator)
    rotation = roma.unitquat_to_rotmat(
        torch.nn.functional.normalize(torch.randn(clouds, 4, generator=generator), dim=1)
    )
    poses = [se3(rotation, torch.randn(clouds, 3, generator=generator))]
    for j in range(2):
        motion = screw_motion(axis[j].expand(clouds, 3), pivot[j].expand(clouds, 3), state[:, j], joint_type)
        poses.append(poses[-1] @ motion)
    pose, part_id = torch.stack(poses, dim=1), torch.arange(96) % 3
    parents = pose[:, :2]
    return {
        "points": transform_points(pose[:, part_id], torch.randn(clouds, 96, 1, 3, generator=generator)).squeeze(2),
        "part_pose": pose,
        "part_center": torch.randn(3, 3, generator=generator).expand(clouds, 3, 3),
        "joint_axis": (parents[..., :3, :3] @ axis[..., None]).squeeze(-1),
        "joint_pivot": transform_points(parents, pivot[:, None]).squeeze(2),
        "joint_state": state + 0.7,  # whose zero is not where the object rests
        "joint_parent": torch.tensor([[0, 1]]).expand(clouds, 2),
        "joint_child": torch.tensor([[1, 2]]).expand(clouds, 2),
        "joint_type": torch.full((clouds, 2), joint_type),
        "dense_part_id": part_id.expand(clouds, 96),
        "instance": torch.arange(clouds),
        "scale": torch.ones(clouds),
    }


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
@pytest.mark.parametrize("source", ["complete", "partial", "chain"])
def test_perfect_outputs_of_the_network_are_ground_truth(tmp_path, joint_type, source):
    if source == "chain":
        labels = chain_of_three(joint_type)
        labels["dense_points"] = labels["points"]
    else:
        protocol = "honest" if source == "partial" else None
        labels = some(write_synthetic_set(tmp_path, view=source, protocol=protocol, joint_type=joint_type), 8)
    clouds, K = labels["part_pose"].shape[:2]
    method = make(NPCSEPN, joint_type, num_parts=K)
    method.read_structure(labels)
    target = Target.of(labels)
    logits = 20 * torch.nn.functional.one_hot(target.part_id, K).float()
    coordinates = target.coordinates(labels["points"])[:, None].expand(-1, K, -1, -1)
    none = torch.zeros(clouds, 1)
    said = WholeShape(none, none, target.center, target.axis, target.pivot, none, none)
    prediction = method.assemble(labels["points"], logits, coordinates, said, none[:, 0])
    errors = cloud_errors(prediction, labels, calibrate(perfect_oracle(labels), labels))
    for name in ("r_err_deg", "axis_err_deg", "state_err"):
        assert errors[name].max() < 0.1, name
    for name in ("t_err", "pivot_err", "chamfer_l1"):
        assert errors[name].nan_to_num().max() < 1e-3, name
    truth = perfect_oracle(labels)
    torch.testing.assert_close(prediction.base_pose, truth.base_pose, atol=1e-3, rtol=0)
    # The root's own joint: the oracle has the others as the object stands, not at rest.
    torch.testing.assert_close(prediction.canonical_axis[:, 0], truth.canonical_axis[:, 0], atol=1e-3, rtol=0)


def test_turning_a_cloud_by_a_group_element_turns_what_npcs_epn_says_and_no_more(synthetic_set):
    labels = {name: value.double() for name, value in some(synthetic_set).items() if value.is_floating_point()}
    method = make(NPCSEPN).double()
    rotation = rotation_group(60).elements[37]
    first, second = method.predict(labels), method.predict(turned(labels, rotation))
    assert torch.equal(first.part_id, second.part_id)
    torch.testing.assert_close(second.joint_state, first.joint_state, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        second.part_pose[..., :3, :3], rotation @ first.part_pose[..., :3, :3], atol=1e-4, rtol=0
    )
    torch.testing.assert_close(second.joint_axis, first.joint_axis @ rotation.T, atol=1e-4, rtol=0)


def test_what_is_turned_farther_than_the_category_allows_is_not_chosen(synthetic_set):
    labels = some(synthetic_set, 8)
    root = labels["part_pose"][:, 0, :3, :3]
    chosen = []
    for degrees in (180.0, 60.0):
        torch.manual_seed(0)
        method = NPCSEPN(Problem(2, REVOLUTE, 1.5, 64, degrees), TINY)
        method.mean_rotation.copy_(root[0])
        rotation = method.predict(labels).part_pose[:, 0, :3, :3]
        frame, _ = method.choose_frames(SurfaceCloud.of(labels["points"], *method.known_surface(labels), TINY))
        chosen.append(roma.rotmat_geodesic_distance(frame, root[:1].expand_as(frame)).rad2deg())
        assert rotation.isfinite().all()
    assert chosen[0].max() > 60 > chosen[1].max()


def test_npcs_kpconv_is_not_equivariant(synthetic_set):
    labels = {name: value.double() for name, value in some(synthetic_set).items() if value.is_floating_point()}
    method = make(KPConv).double()
    rotation = rotation_group(60).elements[37]
    first, second = method.predict(labels), method.predict(turned(labels, rotation))
    assert (second.part_pose[..., :3, :3] - rotation @ first.part_pose[..., :3, :3]).abs().max() > 0.1


def test_features_of_a_turned_copy_are_those_of_the_group_convolution_at_that_element(synthetic_set):
    points = some(synthetic_set)["points"]
    method, group = make(NPCSEPN), rotation_group(60)
    own = method.network.blocks[0]
    kernel = symmetric_kernel_points(group, TINY.num_kernel_points)
    block = GroupConvolutionBlock(8, 8, group, kernel, intra=False)
    block.load_state_dict(own.state_dict())
    features, kernel_points = torch.randn(4, 64, 1, 8), kernel.points.float()
    neighbors = nearest_neighbors(points, 8)
    everything = block(features.expand(-1, -1, 60, -1), correlate(neighbors, 0.3, kernel_points))
    for g in (1, 17, 59):
        copy = neighbors._replace(offset=torch.einsum("ij,bimn->bjmn", group.elements[g].float(), neighbors.offset))
        of_copy = own(features, correlate(copy, 0.3, kernel_points))
        torch.testing.assert_close(of_copy[:, :, 0], everything[:, :, g], atol=1e-4, rtol=0)


def test_frames_of_training_are_right_and_wrong(synthetic_set):
    labels = some(synthetic_set, 8)
    method, target = make(NPCSEPN), Target.of(some(synthetic_set, 8))
    geometry = SurfaceCloud.of(labels["points"], torch.zeros(8, 48, 34), torch.zeros(8, 48, 3), TINY)
    root = target.pose[:, 0, :3, :3]
    right, wrong = method.right_frames(target), method.wrong_frames(geometry, target)

    def angle(frames):
        return roma.rotmat_geodesic_distance(frames, root[:, None].expand_as(frames)).rad2deg()

    assert angle(right)[:, 1].max() < 60 < angle(wrong)[:, 1].min()
    assert angle(right)[:, 0].max() < 45 + 60
    assert angle(wrong)[:, 0].median() > 60


@pytest.mark.parametrize("kind", [NPCSEPN, KPConv])
def test_it_learns_what_a_checkpoint_keeps(synthetic_set, kind, tmp_path):
    labels = some(synthetic_set, 8)
    method = make(kind)
    method.read_structure(labels)
    method.effort = Effort(24, 8, 1e-2)
    optimizer = method.configure_optimizers()["optimizer"]
    losses = []
    for step in range(24):
        loss = method.training_step(labels, step)
        optimizer.zero_grad()
        loss.backward()
        method.on_before_optimizer_step(optimizer)
        optimizer.step()
        losses.append(loss.detach())
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
    torch.save(method.state_dict(), tmp_path / "weights.pt")
    again = make(kind, seed=1)
    again.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True))
    torch.testing.assert_close(again.predict(labels).part_pose, method.predict(labels).part_pose)
    torch.testing.assert_close(again.rest_state, method.rest_state)


def test_the_surface_is_read_once_and_turns_with_the_cloud(synthetic_set, monkeypatch):
    labels, method = some(synthetic_set), make(NPCSEPN)
    images, normal = method.known_surface(labels)
    rotation = roma.random_rotmat(1)[0]
    other = labels | turned(labels, rotation) | {"object_rotation": rotation @ labels["object_rotation"]}
    again = spin_images(other["points"][:, :48], other["dense_points"])
    monkeypatch.setattr("articulate_ssl.baselines.npcs.spin_images", None)
    kept = method.known_surface(other)
    torch.testing.assert_close(kept[0], images, atol=0, rtol=0)
    torch.testing.assert_close(kept[1], normal @ rotation.T, atol=2e-3, rtol=0)
    for one, two in zip(kept, again, strict=True):
        assert (one - two).abs().mean() < 1e-2


def test_without_part_labels_training_says_what_is_missing(synthetic_set):
    labels = some(synthetic_set)
    del labels["dense_part_id"]
    with pytest.raises(ValueError, match="dense_in_fit"):
        make(NPCSEPN).training_step(labels, 0)


def test_distinct_hypotheses_are_far_apart():
    angles = torch.tensor([0.0, 0.1, 1.5, 1.6, 3.0])
    rotation = roma.rotvec_to_rotmat(angles[:, None] * torch.tensor([0.0, 0.0, 1.0]))[None]
    chosen = distinct(torch.tensor([[5.0, 4.0, 2.0, 3.0, 1.0]]), rotation, 4, 1.0)
    assert chosen.tolist() == [[0, 3, 4, 0]]
