"""The mirror image of a cloud says of a mirrored object what the cloud would say of the object."""

from dataclasses import fields, replace

import pytest
import roma
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.handedness import Handedness, in_the_mirror, two_kinds
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.training.explanations import learn_handedness

CLOUDS, SAMPLES = 3, 20


def _prediction(joint_type: int, states: torch.Tensor) -> Prediction:
    """Of clouds that a body and a moving part explain, in some upright orientations."""
    generator = torch.Generator().manual_seed(4)
    rest = torch.rand(2, SAMPLES, 3, generator=generator)  # canonical object space
    center = rest.mean(dim=1)
    base = se3(OrientationRange(80).draw(CLOUDS, generator), torch.rand(CLOUDS, 3, generator=generator))
    axis = torch.nn.functional.normalize(torch.tensor([0.2, 1.0, -0.3]), dim=0).expand(CLOUDS, 1, 3)
    pivot = torch.tensor([0.3, 0.1, 0.9]).expand(CLOUDS, 1, 3)
    motion = screw_motion(axis, pivot, states, joint_type)[:, 0]
    pose = torch.stack([base, base @ motion], dim=1)
    part_pose = pose.clone()
    part_pose[..., :3, 3] = transform_points(pose, center.expand(CLOUDS, 2, 3)[:, :, None])[:, :, 0]
    line = torch.zeros(CLOUDS, 1, dtype=torch.long)
    return Prediction(
        part_id=torch.randint(0, 2, (CLOUDS, SAMPLES), generator=generator),
        part_probability=torch.rand(CLOUDS, SAMPLES, 2, generator=generator),
        part_pose=part_pose,
        part_shape=(rest - center[:, None]).expand(CLOUDS, 2, SAMPLES, 3),
        assembly=center.expand(CLOUDS, 2, 3),
        base_pose=base,
        joint_parent=line,
        joint_child=line + 1,
        joint_type=line + joint_type,
        joint_axis=(base[:, None, :3, :3] @ axis[..., None]).squeeze(-1),
        joint_pivot=transform_points(base, pivot),
        joint_state=states,
        canonical_axis=axis,
        canonical_pivot=pivot,
        reconstruction_error=torch.rand(CLOUDS, generator=generator),
        margin=torch.rand(CLOUDS, generator=generator),
    )


def _posed(prediction: Prediction) -> torch.Tensor:
    return transform_points(prediction.part_pose, prediction.part_shape)


@pytest.fixture
def handedness() -> Handedness:
    own = Handedness()
    own.normal.copy_(torch.nn.functional.normalize(torch.tensor([1.0, 0.1, -0.2]), dim=0))
    own.slope.fill_(30.0)
    own.offset.fill_(-2.0)
    own.learnt.fill_(True)
    return own


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_what_is_mirrored_back_lies_in_the_mirror_and_is_right_handed(handedness, joint_type):
    seen = _prediction(joint_type, torch.tensor([[0.4], [-0.2], [1.0]]))
    back = handedness.mirrored_back(seen)
    torch.testing.assert_close(_posed(back), in_the_mirror(_posed(seen)), atol=1e-5, rtol=0)
    for pose in (back.part_pose, back.base_pose):
        torch.testing.assert_close(torch.linalg.det(pose[..., :3, :3]), torch.ones(pose.shape[:-2]))
    twice = handedness.mirrored_back(back)
    for field in fields(Prediction):
        torch.testing.assert_close(getattr(twice, field.name), getattr(seen, field.name), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_its_joint_moves_its_part_to_where_the_mirror_shows_it(handedness, joint_type):
    """By the same states, about or along the mirrored line, in camera space and in canonical object space."""
    shut, open_ = torch.zeros(CLOUDS, 1), torch.tensor([[0.4], [-0.2], [1.0]])
    before, after = (handedness.mirrored_back(_prediction(joint_type, state)) for state in (shut, open_))
    motion = screw_motion(before.joint_axis, before.joint_pivot, open_, joint_type)[:, 0]
    torch.testing.assert_close(transform_points(motion, _posed(before)[:, 1]), _posed(after)[:, 1], atol=1e-5, rtol=0)
    for name in ("axis", "pivot"):
        own = getattr(before, f"canonical_{name}")
        turned = (before.base_pose[:, None, :3, :3] @ own[..., None]).squeeze(-1)
        if name == "pivot":
            turned = transform_points(before.base_pose, own)
        torch.testing.assert_close(turned, getattr(before, f"joint_{name}"), atol=1e-5, rtol=0)


def test_an_upright_object_stands_in_the_mirror_as_before(handedness):
    """Its orientation is that of the other hand seen from the other side; the identity stays."""
    handedness.normal.copy_(torch.tensor([1.0, 0.0, 0.0]))
    seen = _prediction(REVOLUTE, torch.zeros(CLOUDS, 1))
    back = handedness.mirrored_back(seen)
    turn, mirrored = (p.base_pose[:, :3, :3] for p in (seen, back))
    vector, other = roma.rotmat_to_rotvec(turn), roma.rotmat_to_rotvec(mirrored)
    torch.testing.assert_close(other, vector * torch.tensor([1.0, -1.0, -1.0]), atol=1e-5, rtol=1e-5)


def test_the_likelier_hand_is_taken_cloud_by_cloud(handedness):
    seen, mirrored = (_prediction(REVOLUTE, torch.zeros(CLOUDS, 1)) for _ in range(2))
    seen = replace(seen, reconstruction_error=torch.tensor([1.0, 1.2, 1.0]), margin=torch.ones(3))
    mirrored = replace(mirrored, reconstruction_error=torch.tensor([1.2, 1.0, 0.98]), margin=torch.ones(3))
    odds = handedness.log_odds(seen.reconstruction_error, mirrored.reconstruction_error)
    chosen, rival = handedness.likelier((seen, seen), (mirrored, mirrored), odds)
    back = handedness.mirrored_back(mirrored)
    # The third fits better in the mirror, but not by as much as so rare a hand takes.
    for i, expected in enumerate((seen, back, seen)):
        torch.testing.assert_close(chosen.base_pose[i], expected.base_pose[i])
        torch.testing.assert_close(rival.part_shape[i], expected.part_shape[i])
    assert chosen.margin[2] < chosen.margin[0] <= 1


@pytest.mark.parametrize(
    ("share", "mean", "learnt"),
    [(0.1, 0.15, True), (0.5, 0.15, True), (0.0, 0.15, False), (0.5, 0.0, False)],
    ids=["rare", "half", "one hand", "symmetric"],
)
def test_two_hands_show_in_the_errors_of_clouds(share, mean, learnt):
    generator = torch.Generator().manual_seed(0)
    other = torch.rand(256, generator=generator) < share
    ratio = torch.where(other, mean, -mean) + 0.07 * torch.randn(256, generator=generator)
    handedness, axes = Handedness(), torch.eye(3)[[1, 2, 0]].T
    handedness.learn(ratio.exp(), torch.ones(256), axes)
    assert bool(handedness.learnt) == learnt
    if learnt:
        found = handedness.log_odds(ratio.exp(), torch.ones(256)) > 0
        assert (found == other).float().mean() > 0.96
        assert handedness.normal.tolist() == [1, 0, 0]


def test_two_kinds_are_measured():
    generator = torch.Generator().manual_seed(1)
    other = torch.rand(20_000, generator=generator) < 0.2
    mean, deviation, share = two_kinds(torch.where(other, 2.0, -2.0) + torch.randn(20_000, generator=generator))
    for found, true in ((mean, 2.0), (deviation, 1.0), (share, 0.2)):
        assert float(found) == pytest.approx(true, abs=0.03)


def test_both_hands_are_explained_in_one_batch():
    clouds, handedness = torch.rand(2, 5, 3), Handedness()
    assert handedness.hands(clouds) is clouds
    handedness.learnt.fill_(True)
    torch.testing.assert_close(handedness.hands(clouds), torch.cat([clouds, clouds * torch.tensor([-1.0, 1.0, 1.0])]))


def test_few_clouds_say_nothing():
    handedness = Handedness()
    handedness.learn(torch.full((20,), 2.0), torch.ones(20), torch.eye(3))
    assert not handedness.learnt


def test_predictions_of_mirror_images_are_mirror_images():
    """With hands, a cloud and its mirror image are predicted alike: as each other's mirror images."""
    module = tiny_module(orientation_range=60.0).eval()
    clouds = torch.rand(4, POINTS, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    module.handedness.learnt.fill_(True)
    module.handedness.slope.fill_(30.0)
    seen, mirrored = module.predict_points(clouds), module.predict_points(in_the_mirror(clouds))
    torch.testing.assert_close(_posed(mirrored), in_the_mirror(_posed(seen)), atol=1e-5, rtol=0)
    alone = module.predict_points(clouds, refine=False)
    torch.testing.assert_close(
        _posed(module.predict_points(in_the_mirror(clouds), refine=False)),
        in_the_mirror(_posed(alone)),
        atol=1e-5,
        rtol=0,
    )


def test_hands_are_learnt_from_upright_views_and_part_of_the_weights(monkeypatch):
    module = tiny_module(orientation_range=60.0).eval()
    generator = torch.Generator().manual_seed(3)
    kind = torch.where(torch.arange(96) % 8 == 0, 0.3, -0.3) + 0.05 * torch.randn(96, generator=generator)
    errors = iter(zip(kind.exp().split(16), torch.ones(96).split(16), strict=True))
    monkeypatch.setattr(module.estimator, "mirror_errors", lambda *_: next(errors))
    learn_handedness(module, torch.zeros(96, POINTS, 3))
    assert module.handedness.learnt
    other = tiny_module(orientation_range=60.0)
    other.load_state_dict(module.state_dict())
    torch.testing.assert_close(other.estimator.handedness.slope, module.handedness.slope)
    state = {name: value for name, value in module.state_dict().items() if "handedness" not in name}
    older = tiny_module(orientation_range=60.0)
    older.load_state_dict(state)
    assert not older.handedness.learnt
