"""The clouds of a generated set as recipes ask for them: without labels, with all their points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from articulate_ssl.discovery.grouped import MOST_CLOUDS
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS
from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import split_labels


@dataclass(frozen=True)
class SetClouds:
    """See `recipes.recipe.TrainingClouds`. Which object a cloud shows is known from the recording; it is no label.

    Attributes:
        data: The set, and the set of scans (`data.scans`), which depth views need.
    """

    data: ArticulatedDataModule

    def clouds(self, count: int) -> Tensor:
        """A fixed subset of the training clouds [n, N, 3]."""
        return _points(self.data.discovery_dataloader(count))

    def scans(self, count: int) -> tuple[Tensor, Tensor]:
        """The same of complete clouds, and which object each shows [n].

        Raises:
            ValueError: if there are none.
        """
        self._refuse_views()
        return _with_objects(self.data.discovery_dataloader(count, scans=True))

    def objects(self, count: int) -> tuple[Tensor, Tensor]:
        """Scans of whole objects [n, N, 3], and which object each shows [n].

        Raises:
            ValueError: if there are no complete clouds.
        """
        self._refuse_views()
        return _with_objects(self.data.discovery_dataloader(count, (MIN_CLOUDS, MOST_CLOUDS), scans=True))

    def _refuse_views(self) -> None:
        if self.data.manifest.view != "complete" and self.data.hparams.scans is None:
            raise ValueError(
                f"discovery.grouped needs complete clouds, and {self.data.folder} holds depth views: name a set of "
                "complete clouds of such objects in several states with --data.scans, or leave grouped out"
            )


def _with_objects(batches) -> tuple[Tensor, Tensor]:
    batches = list(batches)
    return _points(batches), torch.cat([batch["instance"] for batch in batches])


def _points(batches) -> Tensor:
    return torch.cat([split_labels(batch)[0]["dense_points"] for batch in batches]).float()
