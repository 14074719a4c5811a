"""One decision for a whole collection: which of two ways of explaining a cloud is the right one.

Laptops can be explained in two ways that fit alike, with the lid as the base and the base as the lid. Single clouds
cannot settle that, a collection can, without labels: whatever tells the two apart, the *same* way of telling must work
for all clouds. So from the relief of both explanations of many clouds (`relief`),

1. the *twin* of an explanation: which part lies where the other explanation has which, and how it is turned there.
   This is the same for all clouds, so the most frequent one among the rivals that predictions come with is taken;
2. the *decision*: the differences of reliefs, whose signs nobody knows, are two Gaussians opposite each other, of one
   covariance. Expectation maximisation finds them, from directions of least kurtosis among whitened principal ones; of
   many starts the likeliest end wins. Least kurtosis itself, and discriminant analysis on its own answers, took another
   difference of laptops for the one that counts (docs/experiments.md, step 224). Last, discriminant analysis of the
   same answers on the clouds as they are and with noise on their points, which hides what is fine: what a scanner
   leaves of it must weigh no more than it is worth;
3. the *surface*: a network that sees where relief is, taught by what the second step is sure of (`surface_decision`);
   and where the twin has two hinged parts exchanged another, taught alike, that sees each of them from near
   (`swapped_parts`). Their odds and those of relief are multiplied, as those of several witnesses.

Where fits tell the explanations apart there is no twin; there the network is taught by fits, and decides between what
fits best and its rival.

Which of the two clusters is called right does not matter: slots have no names, and whatever relates them to labels is
fitted to the answers (`metrics.calibration`).
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.inference.surface_decision import SurfaceDecision, WithSurface
from articulate_ssl.ops.progress import tell

_ALIKE = np.radians(25)  # rotations closer than this are the same twin
# Of the clouds, that must have the same twin; and by how much their two explanations may differ in fit. Chosen.
_COMMON, _CLOSE = 0.5, 0.25
# Kurtosis of the difference between the fits of two explanations. Two clusters 1.55 standard deviations from their
# middle have 2, and whoever goes by the better fit is right for 94 % of them: less needs no other decision. Measured:
# laptops 2.9, washing machines, whose fit is hardly ever wrong, 1.6.
_UNDECIDED = 2.0
_OUTLYING = 4.0  # medians, beyond which a difference counts as this far
_CENTERS = 100  # pairs that are tried as the most frequent relation
FEWEST = 100  # clouds from which a decision is learnt
_RIDGE = 0.3  # of discriminant analysis, in units of a standardised feature's variance
_CAP = 3.0  # standard deviations, beyond which a feature counts as this far
_COMPONENTS = (2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24)  # whitened principal directions, tried in turn
_FLAT = 1e-6  # of the largest principal deviation: less is none
_STARTS, _STEPS, _RATE = 64, 80, 0.15  # of the descent to least kurtosis
_SEARCHES = 4  # in each of these numbers of directions, from other starts
_ROUNDS, _STAYS = 500, 1e-3  # of expectation maximisation at most; and what no answer moves by in the end
# Added to the features' variances, in units of one. Chosen: .01 and .1 end alike, but of 400 clouds .01 elsewhere.
_SLACK = 0.03

log = logging.getLogger(__name__)


class TwoWays(WithSurface):
    """The twin of an explanation, and which of the two is right.

    Attributes:
        learnt: [] whether there is a decision; otherwise there is no twin.
        slot: [K] part j of the twin lies where part slot[j] is.
        turn: [K, 4, 4] T_twin(j) = T(slot[j]) @ turn[j], of poses canonical object space -> cloud.
        scale: [F] standard deviation of the features' differences.
        weight: [F] of the standardised differences, in the logarithm of the odds.
        surface: The network, if there is one; without `learnt` it decides between predictions and their rivals.
        near: The one that sees exchanged parts from near, if there is one.
    """

    NETWORKS = ("surface", "near")
    near: SurfaceDecision | None

    def __init__(self, num_parts: int, num_features: int) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("slot", torch.arange(num_parts))
        self.register_buffer("turn", torch.eye(4).repeat(num_parts, 1, 1))
        self.register_buffer("scale", torch.ones(num_features))
        self.register_buffer("weight", torch.zeros(num_features))

    @property
    def temperature(self) -> Tensor | float:
        """By which the odds of all witnesses are to be divided before they are believed; the last one taught knows."""
        network = self.near or self.surface
        return 1.0 if network is None else network.temperature

    def twin_poses(
        self,
        part_pose: Tensor,  # [B, K, 4, 4]
    ) -> Tensor:  # [B, K, 4, 4]
        """Part poses of the other explanation, before it is registered."""
        return part_pose[:, self.slot] @ self.turn.to(part_pose)

    def relief_odds(
        self,
        one: Tensor,  # [B, F] relief of an explanation
        other: Tensor,  # [B, F] and of its twin
    ) -> Tensor:  # [B]
        """That the first is right; 0 where a relief is not known."""
        known = ~(one.isnan() | other.isnan()).any(dim=1)
        difference = torch.nan_to_num((one - other) / self.scale.to(one)).clamp(-_CAP, _CAP)
        return (difference @ self.weight.to(one)) * known

    def learn_twin(
        self,
        chosen: Tensor,  # [n, K, 4, 4] part poses of predictions
        rival: Tensor,  # [n, K, 4, 4] and of their rivals
        margin: Tensor,  # [n] `Prediction.margin`
    ) -> bool:
        """Take the most frequent relation between explanations that fit alike. False, if none is, or fits decide."""
        close = margin < _CLOSE
        if close.sum() < max(FEWEST, _COMMON * len(margin)):
            return False
        difference = -(1 - margin[close].double()).log()
        difference = difference.clamp(max=_OUTLYING * difference.median())
        if (kurtosis := _kurtosis(difference.cpu().numpy())) < _UNDECIDED:
            tell(log, "fits part the two explanations themselves (kurtosis %.2f)", kurtosis)
            return False
        chosen, rival = chosen[close].double(), rival[close].double()
        # Whose twin is whose is open: both ways are examples.
        here, there = torch.cat([chosen, rival]), torch.cat([rival, chosen])
        found = max((_consensus(here, there, slot) for slot in _involutions(chosen.shape[1])), key=lambda one: one[0])
        share, slot, turn = found
        tell(log, "%.0f %% of the clouds that fit in two ways have the same twin", 100 * share)
        if share * float(close.double().mean()) < _COMMON:
            return False
        self.slot.copy_(torch.tensor(slot))
        self.turn.copy_(turn)
        return True

    def learn_decision(
        self,
        clean: tuple[Tensor, Tensor],  # [n, F] relief of explanations, [n, F] of their twins
        noisy: tuple[Tensor, Tensor],  # the same with noise on the clouds' points
    ) -> bool:
        """Find the direction that parts the differences. False, if there are too few."""
        differences = np.stack([(one - other).double().cpu().numpy() for one, other in (clean, noisy)])  # [2, n, F]
        differences = differences[:, np.isfinite(differences).all(axis=(0, 2))]
        if differences.shape[1] < FEWEST:
            return False
        standardised, _ = scaled_and_capped(differences[0])
        answers = np.sign(standardised @ decision_direction(standardised))
        standardised, scale = scaled_and_capped(np.concatenate(list(differences)))
        weight = _discriminant(standardised, np.tile(answers, 2))
        self.scale.copy_(torch.from_numpy(scale))
        self.weight.copy_(torch.from_numpy(weight))
        self.learnt.fill_(True)
        return True


def decision_direction(
    differences: np.ndarray,  # [n, F] standardised; the sign of each is arbitrary
) -> np.ndarray:  # [F]
    """Weights of the logarithm of the odds that a difference is not to be turned round, up to one common sign."""
    ends = (expectation_maximised(differences, sign) for sign in _starts(differences))
    _, weight, distance = max(ends, key=lambda end: end[0])
    tell(log, "the two explanations are %.1f standard deviations from their middle", distance)
    return weight


def expectation_maximised(
    differences: np.ndarray,  # [n, F] standardised
    sign: np.ndarray,  # [n] a first answer
) -> tuple[float, np.ndarray, float]:
    """Two Gaussians at m and -m of one covariance C, by which differences are turned round or not (McLachlan 2000).

    Second moments S are known whatever the answers are, and C = S - m m^T, so that all that a round asks is m.

    Returns:
        The logarithm of their likelihood, by what it is above one Gaussian's, a sample's mean; weights [F] of the
        logarithm of the odds; the distance of m from 0 in standard deviations.
    """
    moment = differences.T @ differences / len(differences)
    inverse = np.linalg.inv(moment + _SLACK * np.eye(len(moment)))
    answer = sign.astype(float)
    for _ in range(_ROUNDS):
        mean = (answer[:, None] * differences).mean(axis=0)
        weight = inverse @ mean
        share = mean @ weight  # of the variance along m that m explains
        odds = differences @ weight / (1 - share)
        before, answer = answer, np.tanh(odds)
        if np.abs(answer - before).max() < _STAYS:
            break
    log_cosh = np.logaddexp(odds, -odds).mean() - np.log(2)
    likelihood = log_cosh - 0.5 * (np.log(1 - share) + (weight @ moment @ weight + share) / (1 - share))
    return float(likelihood), 2 * weight / (1 - share), float(np.sqrt(share / (1 - share)))


def _starts(differences: np.ndarray) -> Iterator[np.ndarray]:
    """Answers [n] of the direction of most variance, and of directions of least kurtosis."""
    generator = np.random.default_rng(0)
    _, size, directions = np.linalg.svd(differences, full_matrices=False)
    yield np.sign(differences @ directions[0])
    for count in _COMPONENTS:
        if count > min(differences.shape) // 2 or size[count - 1] <= _FLAT * size[0]:
            break
        white = differences @ (directions[:count].T / size[:count] * np.sqrt(len(differences)))
        for _ in range(_SEARCHES):
            yield np.sign(white @ _least_kurtosis(white, generator))


def _least_kurtosis(white: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Unit direction [k] of whitened samples [n, k] along which they have least kurtosis (Pena and Prieto 2001)."""
    weight = generator.normal(size=(white.shape[1], _STARTS))
    weight /= np.linalg.norm(weight, axis=0)
    for _ in range(_STEPS):
        slope = white.T @ (white @ weight) ** 3 / len(white)
        weight -= _RATE * (slope - (slope * weight).sum(axis=0) * weight)
        weight /= np.linalg.norm(weight, axis=0)
    return weight[:, ((white @ weight) ** 4).mean(axis=0).argmin()]


def _discriminant(differences: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Weights [F] of discriminant analysis of differences [n, F] with these signs [n]."""
    turned = sign[:, None] * differences
    mean = turned.mean(axis=0)
    spread = np.cov(turned.T) + _RIDGE * np.eye(len(mean))
    # Two Gaussians at +-mean: the logarithm of the odds is twice the discriminant.
    return 2 * np.linalg.solve(spread, mean)


def scaled_and_capped(differences: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences [n, F] in units of their scale, capped, and that scale [F]."""
    scale = np.sqrt((differences**2).mean(axis=0)) + 1e-9
    return np.clip(differences / scale, -_CAP, _CAP), scale


def _kurtosis(values: np.ndarray) -> float:
    return float((values**4).mean() / (values**2).mean() ** 2)


def _involutions(count: int) -> list[tuple[int, ...]]:
    """Permutations that undo themselves: a twin's twin is the explanation itself."""
    every = itertools.permutations(range(count))
    return [slot for slot in every if all(slot[slot[j]] == j for j in range(count))]


def _consensus(
    here: Tensor,  # [m, K, 4, 4]
    there: Tensor,  # [m, K, 4, 4]
    slot: tuple[int, ...],
) -> tuple[float, tuple[int, ...], Tensor]:  # share, slot, [K, 4, 4]
    """How many pairs are related by the same turn of every part, and that turn."""
    turn = invert_se3(here[:, list(slot)]) @ there  # [m, K, 4, 4]
    rotation = turn[..., :3, :3]
    centers = rotation[:: max(1, len(rotation) // _CENTERS)]
    pairs = (len(centers), *rotation.shape)
    angle = roma.rotmat_geodesic_distance(centers[:, None].expand(pairs), rotation[None].expand(pairs)).amax(dim=-1)
    near = angle < _ALIKE
    same = near[near.sum(dim=1).argmax()]
    mean = roma.special_procrustes(rotation[same].sum(dim=0))
    return float(same.double().mean()), slot, se3(mean, turn[same][..., :3, 3].median(dim=0).values)
