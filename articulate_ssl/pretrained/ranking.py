"""Which of several sets of weights explains a scan best, and how sure that is.

Reconstruction errors of different categories do not compare: a laptop's lid is reconstructed more closely than an oven.
What compares is how unusual an error is among the clouds that the weights were trained on: `ScanPrediction.unlike`. It
is one minus the p-value of the hypothesis that the scan is another such cloud (a conformal test), up to what separates
real scans from the training clouds of all categories alike. Between the weights for depth views of laptops and of ovens
it chose right for 18 and 16 test views and 5 views of a real laptop, also for an oven whose error as a laptop was less.
"""

from __future__ import annotations

from collections.abc import Iterable

from articulate_ssl.inference.scan_prediction import ScanPrediction

# Of a category's own clouds one in twenty is refused.
_PLAUSIBLE = 0.95


def ranked(predictions: Iterable[ScanPrediction]) -> list[ScanPrediction]:
    """Predictions of one scan by several sets of weights, the best explanation first.

    `unlike` decides; among those that it does not tell apart (beyond all training clouds of each), and where one set of
    weights has not learnt it, the reconstruction error relative to the size of the scan.
    """
    predictions = list(predictions)
    if any(prediction.unlike is None for prediction in predictions):
        return sorted(predictions, key=lambda prediction: prediction.relative_error)
    return sorted(predictions, key=lambda prediction: (prediction.unlike, prediction.relative_error))


def how_sure(
    predictions: list[ScanPrediction],  # best first
) -> str:
    """One sentence on the choice among categories."""
    best = predictions[0]
    if any(prediction.unlike is None for prediction in predictions):
        return "chosen by reconstruction error alone: some of the weights do not know what their training clouds had"
    others = dict.fromkeys(p.category for p in predictions if p.unlike < _PLAUSIBLE and p.category != best.category)
    if best.unlike >= _PLAUSIBLE:
        return (
            f"unsure: even {best.category} explains this scan worse than {best.unlike:.0%} of its training clouds; "
            "perhaps it is none of these categories, or more than one object is in the scan"
        )
    if others:
        return f"unsure: {', '.join(others)} would explain this scan, too"
    return f"sure: only {best.category} explains this scan as it explains clouds of its own"
