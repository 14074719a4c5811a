"""How far a prediction can be trusted, learnt from training clouds without labels.

Two answers to one cloud, turned and sampled again, should agree. How often they do, given how clearly a prediction
beats its rival and how well it fits, is a logistic regression: `probability`. A model that is wrong the same way every
time agrees with itself, so this is an upper bound of being right, and the tighter the fewer such errors there are.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit
from torch import Tensor, nn

from articulate_ssl.inference.prediction import Prediction

_QUANTILES = 101  # of the training clouds' errors: percentiles
# Of the squared weights. Where nearly all clouds agree, the few others must not make the regression certain; one pair
# of clouds' worth of doubt. Chosen, not tuned.
_RIDGE = 0.5
_TINY = 1e-3  # of a margin: where all are the same, it says nothing


def relative_error(
    prediction: Prediction,
    points: Tensor,  # [B, N, 3] that were predicted, centred
) -> Tensor:  # [B]
    """Reconstruction error over the size of the cloud: the points' mean distance to the origin."""
    return prediction.reconstruction_error / points.norm(dim=-1).mean(dim=-1)


class Confidence(nn.Module):
    """Probability that a prediction is right, and how unlike the training clouds a cloud is.

    Attributes:
        learnt: Whether `learn` has been called, [].
        quantiles: [101] percentiles of the training clouds' relative errors.
        weights: [3] of the regression: constant, margin, standardised logarithm of the relative error.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("quantiles", torch.zeros(_QUANTILES))
        self.register_buffer("weights", torch.zeros(3))

    @torch.no_grad()
    def learn(
        self,
        error: Tensor,  # [n] relative errors of training clouds
        margin: Tensor,  # [n] of their predictions
        agrees: Tensor,  # [n] bool, whether the same cloud, turned and sampled again, was predicted alike
    ) -> None:
        """Fit percentiles and the regression.

        Raises:
            ValueError: if there is no cloud, or a value is not finite.
        """
        if not len(error) or not (error.isfinite().all() and margin.isfinite().all()):
            raise ValueError("confidence is learnt from one cloud or more, all predicted with finite errors")
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
        self.learnt.fill_(True)

    def probability(self, margin: Tensor, error: Tensor) -> Tensor:  # [B]
        """That orientation and parts are right, of margins [B] and relative errors [B]."""
        return (self._features(margin, error) @ self.weights.to(margin)).sigmoid()

    def unlike(self, error: Tensor) -> Tensor:  # [B] in [0, 1]
        """Share of the training clouds with a smaller relative error than each of [B]."""
        return torch.searchsorted(self.quantiles, error.to(self.quantiles).contiguous()) / _QUANTILES

    def _features(self, margin: Tensor, error: Tensor) -> Tensor:
        middle, upper = self.quantiles[_QUANTILES // 2], self.quantiles[(_QUANTILES * 3) // 4]
        spread = (upper.log() - middle.log()).clamp(min=torch.finfo(error.dtype).eps)
        # What no training cloud was like is no more doubtful than the regression has seen; `unlike` speaks up there.
        standard = ((error.log() - middle.log()) / spread).clamp(-4, 4)
        return torch.stack([torch.ones_like(margin), margin, standard.to(margin)], dim=-1)
