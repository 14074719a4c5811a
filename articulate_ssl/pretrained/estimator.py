"""The Python interface: from a name of weights to an estimator, from points to a `ScanPrediction`.

    from articulate_ssl import load
    prediction = load("laptop").predict(points)

Several sets of weights can answer for one scan (both views of a category, or every category). Then each predicts, and
the one that explains the scan best answers (`pretrained.ranking`).
"""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from typing_extensions import Self

from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.device import usable_device
from articulate_ssl.inference.prediction import ScanEstimate
from articulate_ssl.inference.scan_prediction import ScanPrediction, in_scan_frame
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.pretrained.ranking import ranked
from articulate_ssl.training.checkpoint import load_model
from articulate_ssl.training.shipped_weights import ShippedWeights, find_weights, shipped_as, shipped_weights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard
from datamodules.point_cloud_io import PointCloudError, load_point_cloud, usable_scan

AUTO = "auto"  # every shipped category

logger = logging.getLogger(__name__)

Cloud = np.ndarray | Tensor | str | os.PathLike  # [N, 3] in any unit and origin, or the file of one


class ScanModule(Protocol):
    """What is asked of a trained model.

    Attributes:
        category: What it was trained on.
        state_range: [J, 2] lowest and highest joint state, as `Prediction.joint_state`.
        orientation: How far objects were turned in the clouds that it was trained on.
    """

    category: str
    state_range: Tensor
    orientation: OrientationRange

    def predict_clouds(
        self,
        clouds: Sequence[np.ndarray],  # each [N, 3], any unit and origin
        refine: bool | None,
    ) -> list[ScanEstimate]:
        """What is predicted for each of several scans."""

    def to(self, device: torch.device) -> Self:
        """Move to a device."""


class Estimator(ABC):
    """Predicts scans.

    Attributes:
        category: What is looked for; "auto" where that is one of several categories.
        device: Where it computes; predictions are on the CPU.
        estimators: The sets of weights that may answer, one or more.
    """

    category: str
    device: torch.device
    estimators: tuple[ArticulatedPoseEstimator, ...]

    def predict(self, points: Cloud, refine: bool | None = None) -> ScanPrediction:
        """Parts, poses and joints of the object in one scan, in the frame and the units of the scan.

        Args:
            points: [N, 3] array or tensor of at least 128 points, of one object and nothing else, in any unit; or the
                path of a .ply, .pcd, .npy, .npz or .obj file. Weights of view `depth` take the axes to be those of an
                upright camera: x right, y down, z forward.
            refine: Sharpen by registration; None does what the weights were made with (which is to do so).

        Raises:
            PointCloudError: if the cloud is missing, damaged or unusable.
            CheckpointError: if the weights predict NaN.
        """
        return self.predict_batch([points], refine)[0]

    @abstractmethod
    def predict_batch(self, clouds: Iterable[Cloud], refine: bool | None = None) -> list[ScanPrediction]:
        """`predict` of many clouds at once, faster than one by one, in their order.

        Clouds may differ in size and unit, and none changes another's prediction. All are read before the first is
        predicted.

        Raises:
            PointCloudError: if a cloud is missing, damaged or unusable.
            CheckpointError: if the weights predict NaN.
        """

    @abstractmethod
    def to(self, device: str | torch.device) -> Self:
        """Move to a device.

        Raises:
            DeviceError: if PyTorch cannot compute there.
        """


class ArticulatedPoseEstimator(Estimator):
    """One set of weights.

    Args:
        module: Ready to predict.
        weights: Name or path of the weights, for messages and results.
        card: What is known about them.
        device: Where to compute.

    Raises:
        DeviceError: if PyTorch cannot compute there.

    Attributes:
        module: The trained model; for most it is an `ArticulatedPoseModel`.
        weights: As given.
        card: As given.
    """

    def __init__(
        self,
        module: ScanModule,
        weights: str,
        card: WeightsCard | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.weights, self.card, self.category = weights, card, module.category
        self.estimators, self.module = (self,), module
        self.to(device)

    def predict_batch(self, clouds: Iterable[Cloud], refine: bool | None = None) -> list[ScanPrediction]:
        """See `Estimator.predict_batch`."""
        read = _as_clouds(clouds)
        with flush_denormals():
            estimates = self.module.predict_clouds(read, refine)
        about = self.module.state_range, self.category, self.weights, self.module.orientation.limited
        return [in_scan_frame(estimate, cloud, *about) for estimate, cloud in zip(estimates, read, strict=True)]

    def to(self, device: str | torch.device) -> Self:
        """Move to a device."""
        self.device = usable_device(device)
        self.module = self.module.to(self.device)
        return self

    def __repr__(self) -> str:
        """Which weights, and where."""
        return f"<ArticulatedPoseEstimator: {self.weights} on {self.device}>"


class EstimatorChoice(Estimator):
    """Several sets of weights, of which the one that explains a scan best answers.

    Args:
        estimators: One or more.
        category: See `Estimator`.
    """

    def __init__(self, estimators: Sequence[ArticulatedPoseEstimator], category: str) -> None:
        self.estimators, self.category = tuple(estimators), category
        self.device = self.estimators[0].device

    def predict_batch(self, clouds: Iterable[Cloud], refine: bool | None = None) -> list[ScanPrediction]:
        """See `Estimator.predict_batch`; `checkpoint` of each result names the weights that answered."""
        return [candidates[0] for candidates in self._compare_batch(clouds, refine)]

    def compare(self, points: Cloud, refine: bool | None = None) -> list[ScanPrediction]:
        """What every set of weights predicts, the best explanation first (`ranked`)."""
        return self._compare_batch([points], refine)[0]

    def _compare_batch(self, clouds: Iterable[Cloud], refine: bool | None) -> list[list[ScanPrediction]]:
        read = _as_clouds(clouds)
        answers = [estimator.predict_batch(read, refine) for estimator in self.estimators]
        return [ranked(candidates) for candidates in zip(*answers, strict=True)]

    def to(self, device: str | torch.device) -> Self:
        """Move all to a device."""
        self.device = usable_device(device)
        for estimator in self.estimators:
            estimator.to(device)
        return self

    def __repr__(self) -> str:
        """Which weights, and where."""
        return f"<EstimatorChoice: {', '.join(e.weights for e in self.estimators)} on {self.device}>"


def load(
    name_or_path: str | os.PathLike,
    view: str | None = None,
    device: str | torch.device = "cpu",
) -> ArticulatedPoseEstimator | EstimatorChoice:
    """An estimator, ready to predict.

    Args:
        name_or_path: A category whose weights come with the package ("laptop"), "auto" for every one of them, the name
            of one set of weights ("laptop-depth"), a .ckpt or .safetensors file, a folder that `save_pretrained` wrote,
            or a repository on the Hugging Face hub ("owner/name"); only the last needs a network.
        view: `complete` (any orientation) or `depth` (views of an upright camera) of shipped categories; None takes
            for every scan the one that explains it better.
        device: Where to compute: "cpu", "cuda" or "cuda:<index>".

    Returns:
        An `EstimatorChoice` where several sets of shipped weights are meant, else an `ArticulatedPoseEstimator`.

    Raises:
        CheckpointError: if there are no such weights, they do not fit this version of the code, or a view is chosen of
            weights that do not come with the package.
        DeviceError: if PyTorch cannot compute on the device.
    """
    device = usable_device(device)
    shipped = _every_category(view) if str(name_or_path) == AUTO else shipped_as(str(name_or_path), view)
    estimators = [_estimator(weights.file, weights.name, device) for weights in shipped]
    if len(estimators) > 1:
        return EstimatorChoice(estimators, AUTO if str(name_or_path) == AUTO else shipped[0].category)
    return estimators[0] if estimators else _estimator(find_weights(name_or_path, view), str(name_or_path), device)


def as_cloud(
    points: Cloud,
    name: str = "the points",  # for messages, where they are no file
) -> np.ndarray:  # [N, 3] float64
    """Points of any kind, checked, without what is no part of the object (`datamodules.point_cloud_io`).

    Raises:
        PointCloudError: if they are no usable cloud.
    """
    if isinstance(points, str | os.PathLike):
        return load_point_cloud(points)
    try:
        values = _as_array(points)
    except (ValueError, TypeError, RuntimeError) as error:
        raise PointCloudError(
            f"{name}: no array of numbers of shape [N, 3] ({str(error).splitlines()[0]}); give a dense array or tensor"
        ) from error
    scan = usable_scan(name, values)
    for note in scan.notes:
        logger.warning("%s: %s", name, note)
    return scan.points


def _as_array(points: np.ndarray | Tensor) -> np.ndarray:
    if not isinstance(points, Tensor):
        return np.asarray(points)
    here = points.detach().cpu()
    return (here.double() if here.is_floating_point() else here).numpy()  # numpy knows fewer types than PyTorch


def _as_clouds(clouds: Iterable[Cloud]) -> list[np.ndarray]:
    """As `as_cloud`; of several, messages say which."""
    clouds = list(clouds)
    if len(clouds) == 1:
        return [as_cloud(clouds[0])]
    return [as_cloud(cloud, f"clouds[{i}] of the batch") for i, cloud in enumerate(clouds)]


def _every_category(view: str | None) -> tuple[ShippedWeights, ...]:
    found = tuple(weights for weights in shipped_weights() if view in (None, weights.view))
    if not found:
        raise CheckpointError(
            f"no weights{f' of view {view!r}' if view else ''} come with this package; `make weights` makes them"
        )
    return found


def _estimator(file: Path, weights: str, device: str | torch.device) -> ArticulatedPoseEstimator:
    beside = file.with_suffix(CARD_SUFFIX)
    card = WeightsCard.load(beside) if beside.is_file() else None
    return ArticulatedPoseEstimator(load_model(file), weights, card, device)
