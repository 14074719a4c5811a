"""Which of two explanations is right, decided by the collection: the relation, the direction, what is refused."""

import numpy as np
import pytest
import roma
import torch
from scipy.stats import multivariate_normal

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference import two_ways
from articulate_ssl.inference.relief import NUM_FEATURES, describe_relief, roughness
from articulate_ssl.inference.two_ways import TwoWays, decision_direction, expectation_maximised


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def one_search(monkeypatch):
    """Enough for what is generated here."""
    monkeypatch.setattr(two_ways, "_SEARCHES", 1)


def poses(count: int, generator: torch.Generator) -> torch.Tensor:
    """[count, 2, 4, 4] of two parts that move freely."""
    turn = roma.unitquat_to_rotmat(
        torch.nn.functional.normalize(torch.randn(count, 2, 4, generator=generator, dtype=torch.float64), dim=-1)
    )
    return se3(turn, torch.randn(count, 2, 3, generator=generator, dtype=torch.float64))


def exchange(pose: torch.Tensor) -> torch.Tensor:
    """Each part where the other was, turned by half a turn about z; done twice, nothing has changed."""
    half = se3(torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=pose.dtype)), pose.new_zeros(3))
    return pose[:, [1, 0]] @ half


def margins(kind: str, generator: torch.Generator) -> torch.Tensor:
    """[200] of predictions: how much better they fit than their rivals, relative to those."""
    noise = torch.randn(200, generator=generator)
    return {"about zero": 0.05 * noise, "large": 0.8 + 0.05 * noise, "small, never zero": 0.12 + 0.03 * noise}[
        kind
    ].abs()


def differences(count: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two clusters at +-1.8 standard deviations along one of 16 directions, next to larger scatter; and the signs."""
    noise = torch.randn(count, 16, generator=generator, dtype=torch.float64) * torch.linspace(4, 0.5, 16)
    sign = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)
    noise[:, 10] += sign * 1.8 * torch.linspace(4, 0.5, 16)[10]
    return (noise / noise.square().mean(dim=0).sqrt()).numpy(), sign.numpy()


def test_parts_that_change_places_are_recognised(generator):
    chosen = poses(200, generator)
    rival = exchange(chosen)
    rival[:20] = poses(20, generator)  # some rivals are of another kind
    two_ways = TwoWays(2, 4)
    assert two_ways.learn_twin(chosen, rival, margins("about zero", generator))
    assert two_ways.slot.tolist() == [1, 0]
    torch.testing.assert_close(two_ways.twin_poses(chosen[20:]), rival[20:], atol=1e-4, rtol=0)
    twice = two_ways.twin_poses(two_ways.twin_poses(chosen))
    torch.testing.assert_close(twice, chosen, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "margin, kind",
    [("about zero", "any"), ("large", "exchange"), ("small, never zero", "exchange")],
    ids=["no common twin", "fits differ", "fits part them"],
)
def test_no_twin_where_there_is_none(generator, margin, kind):
    chosen = poses(200, generator)
    rival = exchange(chosen) if kind == "exchange" else poses(200, generator)
    assert not TwoWays(2, 4).learn_twin(chosen, rival, margins(margin, generator))


def test_the_direction_that_parts_two_clusters_is_found_without_labels(generator):
    values, sign = differences(1200, generator)
    answer = np.sign(values @ decision_direction(values)) == sign
    assert max(answer.mean(), 1 - answer.mean()) > 0.93
    # The largest scatter says nothing, which is why principal directions alone do not do.
    largest = np.sign(values[:, 0]) == sign
    assert max(largest.mean(), 1 - largest.mean()) < 0.6


def test_of_two_differences_the_likelier_counts_and_not_the_one_of_least_kurtosis(generator):
    """As of laptops (docs/experiments.md, step 224): what many numbers show together, not what one shows plainly."""
    count = 1500
    values = torch.randn(count, 20, generator=generator, dtype=torch.float64).numpy()
    plain, common = np.where(torch.rand(2, count, generator=generator).numpy() < 0.5, -1.0, 1.0)
    values[:, 0] = 2 * plain + np.sign(values[:, 0]) * np.abs(values[:, 0]) ** 0.5
    values[:, 1:] += 0.5 * common[:, None]
    values, _ = two_ways.scaled_and_capped(values)
    ends = [expectation_maximised(values, sign) for sign in (plain, common)]
    kurtosis = [two_ways._kurtosis(values @ weight) for _, weight, _ in ends]
    assert ends[0][0] < ends[1][0] and kurtosis[0] < kurtosis[1]
    right = (np.sign(values @ decision_direction(values)) == common).mean()
    assert max(right, 1 - right) > 0.95


def test_the_likelihood_never_falls_and_is_that_of_the_mixture(generator, monkeypatch):
    """Against the density written out, where nothing is added to variances."""
    monkeypatch.setattr(two_ways, "_SLACK", 0.0)
    values, sign = differences(400, generator)
    values = values[:, :5]
    found = []
    for rounds in (1, 2, 5, 200):
        monkeypatch.setattr(two_ways, "_ROUNDS", rounds)
        found.append(expectation_maximised(values, sign)[0])
    assert (np.diff(found) > -1e-9).all() and found[-1] > found[0]
    likelihood, weight, distance = expectation_maximised(values, sign)
    moment = values.T @ values / len(values)
    mean = moment @ weight / 2 / (1 + distance**2)  # weight = 2 C^-1 m, and C^-1 m = S^-1 m (1 + distance^2)
    covariance = moment - np.outer(mean, mean)
    normal = [multivariate_normal(side * mean, covariance) for side in (1, -1)]
    mixture = np.logaddexp(*(one.logpdf(values) for one in normal)) - np.log(2)
    one = multivariate_normal(np.zeros(5), moment).logpdf(values)
    np.testing.assert_allclose(likelihood, (mixture - one).mean(), atol=1e-4)
    np.testing.assert_allclose(values @ weight, normal[0].logpdf(values) - normal[1].logpdf(values), atol=1e-6)


def test_relief_odds_are_antisymmetric_and_say_how_sure(generator):
    values, sign = differences(1200, generator)
    one = torch.from_numpy(values)
    two_ways = TwoWays(1, 16)
    assert two_ways.learn_decision(*[(one, torch.zeros_like(one))] * 2)
    odds = two_ways.relief_odds(one, torch.zeros_like(one))
    torch.testing.assert_close(two_ways.relief_odds(torch.zeros_like(one), one), -odds)
    right = torch.from_numpy(sign).sign() == odds.sign()
    right = right if right.double().mean() > 0.5 else ~right
    sure = odds.abs() > odds.abs().median()
    assert right[sure].double().mean() > 0.99 > right[~sure].double().mean()
    one[0, 3] = torch.nan
    assert two_ways.relief_odds(one, torch.zeros_like(one))[0] == 0


def test_too_few_clouds_decide_nothing(generator):
    values = torch.from_numpy(differences(60, generator)[0])
    two_ways = TwoWays(1, 16)
    assert not two_ways.learn_decision(*[(values, torch.zeros_like(values))] * 2)
    assert not two_ways.learnt


def test_what_noise_hides_weighs_less_than_what_it_leaves(generator):
    """The finest difference is the clearest; with noise, nothing of it is left, but one that is less clear is."""

    def clouds(count: int, noise: bool) -> tuple[torch.Tensor, torch.Tensor]:
        values, sign = torch.randn(count, 16, generator=generator, dtype=torch.float64), torch.ones(count).double()
        sign[torch.rand(count, generator=generator) < 0.5] = -1
        values[:, 2] += sign * (0 if noise else 4)
        values[:, 5] += sign * 1.5
        return values, sign

    def right(two_ways: TwoWays, noise: bool) -> float:
        values, sign = clouds(4000, noise)
        share = float((two_ways.relief_odds(values, torch.zeros_like(values)).sign() == sign).double().mean())
        return max(share, 1 - share)

    clean, sign = clouds(1000, noise=False)
    noisy = clean.clone()
    noisy[:, 2] -= 4 * sign
    none = torch.zeros_like(clean)
    without, with_noise = TwoWays(1, 16), TwoWays(1, 16)
    without.learn_decision((clean, none), (clean, none))
    with_noise.learn_decision((clean, none), (noisy, none))
    assert right(without, noise=False) > 0.99 and right(with_noise, noise=False) > 0.99
    assert right(with_noise, noise=True) > right(without, noise=True) + 0.02


@pytest.mark.parametrize("which", [0, 1])
def test_clouds_without_relief_teach_nothing(generator, which):
    values = torch.from_numpy(differences(120, generator)[0])
    reliefs = [(values, torch.zeros_like(values)) for _ in range(2)]
    lost = values.clone()
    lost[:30, 3] = torch.nan
    reliefs[which] = lost, reliefs[which][1]
    assert not TwoWays(1, 16).learn_decision(*reliefs)  # 90 are too few


def test_weights_from_before_there_was_a_decision_load():
    two_ways = TwoWays(2, 4)
    two_ways.learnt.fill_(True)
    two_ways.load_state_dict({})
    assert two_ways.state_dict().keys() == {"learnt", "slot", "turn", "scale", "weight"}


def plate(generator: torch.Generator, rough: float) -> np.ndarray:
    """[1000, 3]: both faces of a plate 1 x .6 x .2, the upper one as rough as said."""
    points = torch.rand(1000, 3, generator=generator, dtype=torch.float64) - 0.5
    points[:, 2] = 0.1 * torch.where(points[:, 2] > 0, 1.0, -1.0)
    points[:, 2] += (points[:, 2] > 0) * rough * torch.randn(1000, generator=generator, dtype=torch.float64)
    return (points * torch.tensor([1.0, 0.6, 1.0])).numpy()


def test_relief_moves_with_the_parts_and_knows_them_apart(generator):
    rough, flat = plate(generator, 0.006), plate(generator, 0.0)
    points, label = np.concatenate([rough, flat]), np.repeat([0, 1], 1000)
    pose = poses(1, generator)[0].numpy()
    posed = np.concatenate([p @ pose[k, :3, :3].T + pose[k, :3, 3] for k, p in enumerate((rough, flat))])
    axes = np.stack([np.eye(3)[:, [2, 1, 0]]] * 2)  # thin, middle, long
    nowhere = np.zeros((0, 3))
    still = describe_relief(points, label, np.stack([np.eye(4)] * 2), axes, nowhere, nowhere)
    assert still.shape == (2 * NUM_FEATURES,)
    # Neighbours of a point are found among its own part's points, so that moving parts apart changes nothing.
    np.testing.assert_allclose(describe_relief(posed, label, pose, axes, nowhere, nowhere), still, atol=1e-4)
    assert np.median(roughness(rough)[rough[:, 2] > 0, 0]) > np.median(roughness(flat)[:, 0]) + 1


def test_what_lies_next_to_a_joint_is_left_out(generator):
    points = plate(generator, 0.003)
    whole = np.stack([np.eye(4)]), np.stack([np.eye(3)[:, [2, 1, 0]]])
    label = np.zeros(len(points), dtype=int)
    line = np.array([[0.0, -0.3, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    far = points[np.hypot(points[:, 1] + 0.3, points[:, 2]) > 0.12]
    nowhere = np.zeros((0, 3))
    near = describe_relief(points, label, *whole, *line)
    without = describe_relief(far, label[: len(far)], *whole, nowhere, nowhere)
    np.testing.assert_allclose(near, without)
    assert near[1] < describe_relief(points, label, *whole, nowhere, nowhere)[1] - 0.05  # the middle extent


def test_a_lost_part_has_no_relief(generator):
    points = plate(generator, 0.0)
    label = np.zeros(len(points), dtype=int)
    label[:30] = 1
    axes, nowhere = np.stack([np.eye(3)] * 2), np.zeros((0, 3))
    found = describe_relief(points, label, np.stack([np.eye(4)] * 2), axes, nowhere, nowhere)
    assert np.isnan(found[NUM_FEATURES:]).all() and np.isfinite(found[:NUM_FEATURES]).all()


def test_what_has_no_thickness_has_no_relief():
    points = np.zeros((100, 3))
    points[:, :2] = np.random.default_rng(0).random((100, 2))
    nowhere = np.zeros((0, 3))
    found = describe_relief(points, np.zeros(100, dtype=int), np.eye(4)[None], np.eye(3)[None], nowhere, nowhere)
    assert np.isnan(found).all()
