"""How far a prediction can be trusted, learnt from training clouds without labels.

Two answers to one cloud, turned and sampled again, should agree. How often they do, given how clearly a prediction
beats its rival and how well it fits, is a logistic regression: `probability`. A model that is wrong the same way every
time agrees with itself, so this is an upper bound of being right, and the tighter the fewer such errors there are.

Training clouds say nothing of what fits worse than any of them. So the same clouds are stretched, which leaves known
what is to be predicted, until they are like none: how often predictions still agree, given by how much a fit is worse
than that of 99 % of the training clouds, is one more weight.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit
from torch import Tensor

from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.inference.prediction import Prediction

_QUANTILES = 101  # of the training clouds' errors: percentiles
_LIKE = 99  # the percentile up to which a cloud is like those of training, as in the warning of `unlike`
# Of the squared weights. Where nearly all clouds agree, the few others must not make the regression certain; one pair
# of clouds' worth of doubt. Chosen, not tuned.
_RIDGE = 0.5
_STEEPEST = -20.0  # of what an excess is worth
_TINY = 1e-3  # of a margin: where all are the same, it says nothing


def relative_error(
    prediction: Prediction,
    points: Tensor,  # [B, N, 3] that were predicted, centred
) -> Tensor:  # [B]
    """Reconstruction error over the size of the cloud: the points' mean distance to the origin."""
    return prediction.reconstruction_error / points.norm(dim=-1).mean(dim=-1)


class Confidence(LateBuffers):
    """Probability that a prediction is right, and how unlike the training clouds a cloud is.

    Attributes:
        learnt: Whether `learn` has been called, [].
        quantiles: [101] percentiles of the training clouds' relative errors.
        weights: [3] of the regression: constant, margin, standardised logarithm of the relative error.
        strangeness: [] of that logarithm's excess over that of 99 % of the training clouds; 0 or less.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("quantiles", torch.zeros(_QUANTILES))
        self.register_buffer("weights", torch.zeros(3))
        self.register_buffer("strangeness", torch.tensor(0.0))

    @torch.no_grad()
    def learn(
        self,
        error: Tensor,  # [n] relative errors of training clouds
        margin: Tensor,  # [n] of their predictions
        agrees: Tensor,  # [n] bool, whether the same cloud, turned and sampled again, was predicted alike
    ) -> None:
        """Fit percentiles and the regression; what is unlike is no more doubtful yet.

        Raises:
            ValueError: if there is no cloud, or a value is not finite.
        """
        _refuse_unfit(error, margin)
        self.quantiles.copy_(torch.quantile(error, torch.linspace(0, 1, _QUANTILES).to(error)))
        features = self._features(margin, error).double().cpu().numpy()
        # Margins of some searches span tenths, of others hundredths: the ridge is to hold down neither more.
        spread = max(features[:, 1].std(), _TINY)
        features[:, 1] /= spread
        sign = np.where(agrees.cpu().numpy(), 1.0, -1.0)

        def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
            score = sign * (features @ weights)
            value = np.logaddexp(0, -score).sum() + _RIDGE * weights @ weights
            return value, -(sign * expit(-score)) @ features + 2 * _RIDGE * weights

        found = minimize(loss, np.zeros(3), jac=True).x
        self.weights.copy_(torch.from_numpy(found / [1, spread, 1]))
        self.strangeness.zero_()
        self.learnt.fill_(True)

    @torch.no_grad()
    def learn_strangeness(
        self,
        error: Tensor,  # [n] relative errors of clouds of which some are unlike those of training
        margin: Tensor,  # [n] of their predictions
        agrees: Tensor,  # [n] bool, whether predictions are as they have to be
    ) -> None:
        """Fit what unlike clouds are worth beside the regression (`learn`), which stays as it is.

        Raises:
            ValueError: if there is no cloud, or a value is not finite.
        """
        _refuse_unfit(error, margin)
        known = (self._features(margin, error) @ self.weights.to(margin)).double().cpu().numpy()
        excess = self._excess(error).double().cpu().numpy()
        sign = np.where(agrees.cpu().numpy(), 1.0, -1.0)

        def loss(weight: float) -> float:
            return np.logaddexp(0, -sign * (known + weight * excess)).sum() + _RIDGE * weight**2

        self.strangeness.fill_(float(minimize_scalar(loss, bounds=(_STEEPEST, 0), method="bounded").x))

    def probability(self, margin: Tensor, error: Tensor) -> Tensor:  # [B]
        """That orientation and parts are right, of margins [B] and relative errors [B]."""
        score = self._features(margin, error) @ self.weights.to(margin)
        return (score + self.strangeness.to(margin) * self._excess(error).to(margin)).sigmoid()

    def unlike(self, error: Tensor) -> Tensor:  # [B] in [0, 1]
        """Share of the training clouds with a smaller relative error than each of [B]."""
        return torch.searchsorted(self.quantiles, error.to(self.quantiles).contiguous()) / _QUANTILES

    def _features(self, margin: Tensor, error: Tensor) -> Tensor:
        # Beyond what training clouds were like the regression has seen nothing.
        standard = self._standard(error).clamp(-4, 4)
        return torch.stack([torch.ones_like(margin), margin, standard.to(margin)], dim=-1)

    def _excess(self, error: Tensor) -> Tensor:
        return (self._standard(error) - self._standard(self.quantiles[_LIKE])).clamp(min=0)

    def _standard(self, error: Tensor) -> Tensor:
        """Logarithms of relative errors from the middle, in units of what a quarter of the training clouds spans."""
        middle, upper = self.quantiles[_QUANTILES // 2], self.quantiles[(_QUANTILES * 3) // 4]
        spread = (upper.log() - middle.log()).clamp(min=torch.finfo(error.dtype).eps)
        return (error.log() - middle.log()) / spread


def _refuse_unfit(error: Tensor, margin: Tensor) -> None:
    if not len(error) or not (error.isfinite().all() and margin.isfinite().all()):
        raise ValueError("confidence is learnt from one cloud or more, all predicted with finite errors")
