"""Whether a method knows when it is right: ranking, calibration and the more confident half.

Everything here takes what a method says about S clouds beside their errors; nothing is fitted.
"""

from __future__ import annotations

import math

import torch
from scipy.stats import rankdata
from torch import Tensor

from articulate_ssl.metrics.functional import ABOVE_DEG, FLIP_DEG

BINS = 10


def auroc(
    score: Tensor,  # [S] any real numbers
    positive: Tensor,  # [S] bool
) -> float:
    """Probability that a random positive scores above a random negative, ties counting half; NaN if either is missing.

    The rank statistic of Mann and Whitney. torchmetrics' AUROC is the same number for scores in [0, 1], but it passes
    others through a sigmoid, which makes all large ones equal.

    Raises:
        ValueError: if a score is NaN.
    """
    _refuse_nan(score=score)
    positive = positive.bool().cpu()
    ones = int(positive.sum())
    zeros = len(positive) - ones
    if ones == 0 or zeros == 0:
        return math.nan
    rank = torch.from_numpy(rankdata(score.double().cpu().numpy()))
    return float((rank[positive].sum() - ones * (ones + 1) / 2) / (ones * zeros))


def reliability_table(
    confidence: Tensor,  # [S] in [0, 1]
    correct: Tensor,  # [S] bool
    bins: int = BINS,
) -> dict[str, list | float]:
    """How often clouds of each confidence are right, in bins of equal width (Guo et al. 2017).

    Returns:
        `edges` (bins + 1), and per bin `count`, `mean_confidence` and `share_correct` (None in an empty bin). A bin
        includes its lower edge, the last one both. `expected_calibration_error` is the mean of |mean confidence - share
        correct| over clouds; NaN without clouds.

    Raises:
        ValueError: if a confidence is outside [0, 1] or NaN.
    """
    _refuse_nan(confidence=confidence)
    confidence, correct = confidence.double().cpu(), correct.bool().cpu()
    if ((confidence < 0) | (confidence > 1)).any():
        raise ValueError("confidence must be in [0, 1] to be compared with shares")
    edges = torch.linspace(0, 1, bins + 1, dtype=torch.float64)
    index = (torch.bucketize(confidence, edges, right=True) - 1).clamp(max=bins - 1)
    groups = [index == b for b in range(bins)]

    def means(values: Tensor) -> list[float | None]:
        return [float(values[g].double().mean()) if g.any() else None for g in groups]

    # torchmetrics' calibration error puts confidences of exactly 1 into a bin of their own: the table would not add up.
    gaps = [float((confidence[g] - correct[g].double()).sum().abs()) for g in groups]
    error = sum(gaps) / len(confidence) if len(confidence) else math.nan
    return {
        "edges": edges.tolist(),
        "count": [int(g.sum()) for g in groups],
        "mean_confidence": means(confidence),
        "share_correct": means(correct),
        "expected_calibration_error": error,
    }


def confident_half(
    error: Tensor,  # [S] or [S, K], degrees
    confidence: Tensor,  # [S] any real numbers
) -> dict[str, int | float | None]:
    """Errors of the more confident half of the clouds (of an odd number the larger half; ties in the clouds' order).

    Returns:
        `samples`; `mean` and `median` of each cloud's mean over its parts, degrees; `flips`, the clouds with any part
        above 90 degrees; `share_of_all_flips`, those flips among the flips of all clouds: 0.5 for a confidence that
        knows nothing, 0 for one that knows all. None where nothing was flipped, and for no cloud.

    Raises:
        ValueError: if a confidence is NaN.
    """
    _refuse_nan(confidence=confidence)
    error = error.double().cpu().reshape(len(confidence), -1)
    order = confidence.double().cpu().argsort(descending=True, stable=True)
    half = order[: (len(order) + 1) // 2]
    flipped = (error > FLIP_DEG).any(1)
    mean, flips, all_flips = error.mean(1)[half], int(flipped[half].sum()), int(flipped.sum())
    return {
        "samples": len(half),
        "mean": float(mean.mean()) if len(half) else None,
        "median": float(mean.quantile(0.5)) if len(half) else None,
        "flips": flips,
        "share_of_all_flips": flips / all_flips if all_flips else None,
    }


def report_confidence(
    confidence: Tensor,  # [S]
    r_err_deg: Tensor,  # [S] or [S, K], unfolded
    bins: int = BINS,
) -> dict[str, object]:
    """What a confidence is worth, as plain numbers for metrics.json.

    A cloud is correct if no part's rotation error is above 30 degrees.

    Returns:
        `auroc_correct` and `auroc_not_flipped`: how well the confidence ranks correct clouds above others, and those
        without a flip above flipped ones (None where all clouds are alike); `reliability`, the table (None unless all
        confidences are in [0, 1]); `confident_half`.

    Raises:
        ValueError: if a confidence is NaN, or there are not as many as errors.
    """
    if confidence.ndim != 1 or len(confidence) != len(r_err_deg):
        raise ValueError(f"confidence is {tuple(confidence.shape)}, errors are of {len(r_err_deg)} clouds")
    _refuse_nan(confidence=confidence)
    worst = r_err_deg.reshape(len(confidence), -1).amax(1)
    ranks = {
        "auroc_correct": auroc(confidence, worst <= ABOVE_DEG),
        "auroc_not_flipped": auroc(confidence, worst <= FLIP_DEG),
    }
    shares = len(confidence) > 0 and bool(((confidence >= 0) & (confidence <= 1)).all())
    return {
        **{name: None if math.isnan(value) else value for name, value in ranks.items()},
        "reliability": reliability_table(confidence, worst <= ABOVE_DEG, bins) if shares else None,
        "confident_half": confident_half(r_err_deg, confidence),
    }


def _refuse_nan(**values: Tensor) -> None:
    for name, value in values.items():
        if value.isnan().any():
            raise ValueError(f"{name} has a NaN for cloud {int(value.isnan().nonzero()[0])}")
