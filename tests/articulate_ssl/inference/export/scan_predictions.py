"""The predictions of `synthetic_predictions` as an export reads them."""

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch

from articulate_ssl.inference.export import rigid_links
from articulate_ssl.inference.prediction import ScanEstimate
from articulate_ssl.inference.scan_prediction import ScanPrediction, in_scan_frame


def keep_solid(patch: pytest.MonkeyPatch) -> None:
    """Cut nothing out of parts: what others slide through is bounded by new vertices, whose place no point tells."""
    patch.setattr(rigid_links, "hollow_parents", lambda meshes, slides: list(meshes))


OBJECTS = [synthetic.laptop, synthetic.drawer, synthetic.arm]
CENTER, SCALE = np.array([10.0, -3.0, 5.0]), 0.4


def result_of(make, center=CENTER, scale=SCALE, **changes) -> ScanPrediction:
    prediction, points = make()
    points = points.numpy()
    estimate = dict(prediction=prediction, rival=None, points=points, center=center, scale=scale)
    estimate |= dict(probability=None, unlike=None)
    estimate |= {name: changes.pop(name) for name in estimate.keys() & changes.keys()}
    arguments = dict(
        cloud=points.astype(np.float64) * scale + center,
        state_range=torch.tensor([[-0.1, 0.3]]).repeat(prediction.joint_state.shape[1], 1),
        category="thing",
        checkpoint="thing.ckpt",
    )
    return in_scan_frame(ScanEstimate(**estimate), **(arguments | changes))
