"""The predictions of `synthetic_predictions` as an export reads them."""

from pathlib import Path

import numpy as np
import synthetic_predictions as synthetic
import torch

from articulate_ssl.inference.export.scan_result import ScanResult, in_scan_frame

OBJECTS = [synthetic.laptop, synthetic.drawer, synthetic.arm]
CENTER, SCALE = np.array([10.0, -3.0, 5.0]), 0.4


def result_of(folder: Path, make, center=CENTER, scale=SCALE, **changes) -> ScanResult:
    prediction, points = make()
    points = points.numpy()
    arguments = dict(
        prediction=prediction,
        points=points,
        center=center,
        scale=scale,
        cloud=points.astype(np.float64) * scale + center,
        state_range=torch.tensor([[-0.1, 0.3]]).repeat(prediction.joint_state.shape[1], 1),
        category="thing",
        checkpoint="thing.ckpt",
    )
    return in_scan_frame(folder, **(arguments | changes))
