"""The DataModule of every category, source and view."""

from __future__ import annotations

import logging
import warnings
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from datamodules.articulated_dataset import ArticulatedDataset, Batch, clouds_of_objects, evenly, spread_subset
from datamodules.manifest import MANIFEST_NAME, PROTOCOLS, VIEWS, Manifest, ManifestError, set_folder
from datamodules.samplers import EvaluationSampler, TrainingStream

log = logging.getLogger(__name__)


class ArticulatedDataModule(LightningDataModule):
    """Batches from a set that `make data` generated.

    A batch is a dict of tensors. B clouds, N input points, P stored points, K parts, J joints; normalised units,
    camera space:

        points           [B, N, 3] the network's input: the first N of the farthest-point ordered cloud
        sample           [B] index of the sample in its split
        dense_points     [B, P, 3] all stored points; in training only with `dense_in_fit`
        dense_part_id    [B, P] part of each of them
        occupancy_points [B, M, 3] points around the object; only in training and validation with `occupancy`
        occupancy        [B, M] 1 for those inside it, else 0

    and, for metrics only, every other array of `datamodules.shards.SHARD_ARRAYS` under its own name, integers as int64;
    without labels (`manifest.labelled`) only those of `UNLABELLED_ARRAYS`, and no `dense_part_id`.
    `datamodules.articulated_dataset.split_labels` separates inputs from labels.

    Training on complete clouds turns each cloud by a fresh uniform rotation every time it is drawn. What is drawn, and
    how it is turned, depends on `seed` and on the number of samples consumed so far and on nothing else. That number is
    part of every Lightning checkpoint, so resuming continues with the batches that an uninterrupted run would have
    seen. Validation uses a fixed subset of the training clouds; fitting never opens the test split.

    Args:
        category: Category name.
        root: The folder that `make data` wrote to (its `OUT`).
        source: Where the objects come from.
        view: `complete` or `partial`.
        protocol: `honest` (the default) or `eap` for partial views.
        num_points: N.
        batch_size: B, per device.
        num_workers: Loader processes; changes no result.
        noise_std: Gaussian noise per coordinate of training and validation points, in normalised units.
        test_noise_std: The same for test points.
        seed: Of order, rotation and noise in training. Test batches do not depend on it.
        val_samples: Number of training clouds in the validation set, 0 for no validation.
        max_test_samples: Test on at most this many samples, spread evenly over instances, states and rotations; the
            same ones every time.
        dense_in_fit: Deliver the dense arrays in training and validation too.
        calibration_set: Folder of the set whose training clouds calibrate metrics, if not this set's own: what the
            network was trained on, when it is tested on objects or views from elsewhere.
        scans: Folder of a set of complete clouds of the same category, in which parts are discovered in the multi-state
            setting (`model.discovery.grouped`) instead of this set's, which cannot serve where they are depth views. It
            must be there, whether it is read or not.
        occupancy: Deliver occupancy samples in training and validation; the set must have them
            (`datamodules.occupancy`).
        verify: Compare every shard with its checksum when a stage begins.

    Raises:
        ManifestError, ShardError: from `setup`, naming the file and what to do.
        ValueError: if an argument makes no sense.
    """

    def __init__(
        self,
        category: str,
        root: str = "data",
        source: str = "procedural",
        view: str = "complete",
        protocol: str | None = None,
        num_points: int = 512,
        batch_size: int = 8,
        num_workers: int = 0,
        noise_std: float = 0.0,
        test_noise_std: float = 0.0,
        seed: int = 0,
        val_samples: int = 64,
        max_test_samples: int | None = None,
        dense_in_fit: bool = False,
        calibration_set: str | None = None,
        scans: str | None = None,
        occupancy: bool = False,
        verify: bool = True,
    ) -> None:
        super().__init__()
        if view not in VIEWS:
            raise ValueError(f"view={view!r}, expected one of {', '.join(VIEWS)}")
        if view == "partial":
            protocol = protocol or PROTOCOLS[0]
            if protocol not in PROTOCOLS:
                raise ValueError(f"protocol={protocol!r}, expected one of {', '.join(PROTOCOLS)}")
        elif protocol is not None:
            raise ValueError(f"protocol={protocol!r} with view={view!r}: only partial views have a protocol")
        for name, value, least in (
            ("num_points", num_points, 1),
            ("batch_size", batch_size, 1),
            ("num_workers", num_workers, 0),
            ("noise_std", noise_std, 0),
            ("test_noise_std", test_noise_std, 0),
            ("seed", seed, 0),
            ("val_samples", val_samples, 0),
            ("max_test_samples", max_test_samples, 1),
        ):
            if value is not None and value < least:
                raise ValueError(f"{name}={value}, must be at least {least}")
        self.save_hyperparameters(logger=False)
        self.hparams["protocol"] = protocol  # under LightningCLI the line above saves what the user gave
        self.consumed_samples = 0

    @property
    def folder(self) -> Path:
        """Folder of the data set."""
        options = self.hparams
        return set_folder(options.root, options.category, options.source, options.view, options.protocol)

    @cached_property
    def manifest(self) -> Manifest:
        """The set's manifest.

        Raises:
            ManifestError: if the set does not exist (with the command that makes it), or is another one than asked for.
        """
        if not (self.folder / MANIFEST_NAME).exists():
            raise ManifestError(f"{self.folder}: no complete data set here. Make it with: {self._make_command()}")
        manifest = Manifest.load(self.folder)
        for name in ("category", "source", "view", "protocol"):
            if (found := getattr(manifest, name)) != self.hparams[name]:
                raise ManifestError(f"{self.folder / MANIFEST_NAME}: {name} is {found!r}, not {self.hparams[name]!r}.")
        return manifest

    def setup(self, stage: str) -> None:
        """Open and check the split of a stage: `fit` (with the manifest of `scans`), `validate` or `test`."""
        options = self.hparams
        common = {"folder": self.folder, "num_points": options.num_points, "verify": options.verify}
        for cached in ("manifest", "_scans", "_scanned_test_objects"):
            self.__dict__.pop(cached, None)
        if stage == "fit" and options.scans is not None:
            _ = self._scans  # refuses a wrong folder also where no recipe reads it
        if stage in ("fit", "validate"):
            common |= {"noise_std": options.noise_std, "dense": options.dense_in_fit, "seed": options.seed}
            common |= {"rotate": self.manifest.view == "complete", "occupancy": options.occupancy}
            self.train_set = ArticulatedDataset(split="train", **common)
            if stage == "fit":
                self.consumed_samples = 0
        elif stage == "test":
            self.test_set = ArticulatedDataset(split="test", noise_std=options.test_noise_std, **common)

    def train_dataloader(self) -> DataLoader:
        """Endless stream of training samples, cut into epochs of about one pass."""
        # It is resumable, through `state_dict` below, which Lightning's test for resumable loaders does not see.
        warnings.filterwarnings("ignore", ".*your dataloader is not resumable.*")
        options = self.hparams
        stream = TrainingStream(
            self.train_set, options.batch_size, lambda: self.consumed_samples, options.seed, *self._world()
        )
        return self._loader(self.train_set, stream)

    def val_dataloader(self) -> DataLoader | list:
        """A fixed subset of the training clouds, each under one fixed rotation."""
        if not self.hparams.val_samples:
            return []
        subset = spread_subset(self.train_set.labels["instance"], self.hparams.val_samples)
        return self._loader(self.train_set, EvaluationSampler(subset, *self._world()))

    def test_dataloader(self) -> DataLoader:
        """Test samples as stored."""
        limit = self.hparams.max_test_samples
        instance = self.test_set.labels["instance"]
        subset = np.arange(len(instance)) if limit is None else spread_subset(instance, limit)
        return self._loader(self.test_set, EvaluationSampler(subset, *self._world()))

    def calibration_dataloader(self, samples: int = 128) -> DataLoader:
        """A fixed subset of the training clouds for calibrating metrics, in any stage and whole on every rank.

        Clouds are without noise, under one fixed rotation each if complete, with the dense arrays.

        Args:
            samples: Size of the subset, spread evenly over instances and states.
        """
        options = self.hparams
        folder = self.folder if options.calibration_set is None else Path(options.calibration_set)
        manifest = self.manifest if options.calibration_set is None else Manifest.load(folder)
        if not manifest.num_samples("train"):
            raise ManifestError(
                f"{folder}: has no training clouds to calibrate metrics on; name the set that the network was trained "
                "on with --data.calibration_set"
            )
        if not manifest.labelled:
            raise ManifestError(
                f"{folder}: has no labels to calibrate metrics on; name a labelled set of the same objects and view "
                "with --data.calibration_set"
            )
        rotate = manifest.view == "complete"
        dataset = ArticulatedDataset(folder, "train", options.num_points, rotate, verify=options.verify)
        return self._loader(dataset, EvaluationSampler(spread_subset(dataset.labels["instance"], samples)))

    def discovery_dataloader(
        self, samples: int, per_object: tuple[int, int] | None = None, scans: bool = False
    ) -> DataLoader:
        """Training clouds spread evenly over the split, chosen without looking at any label; as for calibration.

        Args:
            samples: How many.
            per_object: Fewest and most clouds of an object, where clouds of the same objects are wanted
                (`clouds_of_objects`). Which object a cloud shows is known from the recording; it is no label.
            scans: Of the set `scans` instead, if one is named, but for objects that this set's test split shows.

        Raises:
            ManifestError: if that set is of another category, not of complete clouds, or only of such objects.
        """
        other = scans and self.hparams.scans is not None
        folder, manifest = (Path(self.hparams.scans), self._scans) if other else (self.folder, self.manifest)
        rotate, verify = manifest.view == "complete", self.hparams.verify
        dataset = ArticulatedDataset(folder, "train", self.hparams.num_points, rotate, verify=verify)
        rows = np.arange(len(dataset))
        if other:
            tested = [manifest.instances["train"].index(one) for one in self._scanned_test_objects]
            rows = rows[~np.isin(dataset.labels["instance"], tested)]
        if per_object is None:
            chosen = evenly(rows, samples)
        else:
            chosen = rows[clouds_of_objects(dataset.labels["instance"][rows], samples, *per_object)]
        return self._loader(dataset, EvaluationSampler(np.random.default_rng(self.hparams.seed).permutation(chosen)))

    @cached_property
    def _scans(self) -> Manifest:
        """Of the set `scans`."""
        folder = self.hparams.scans
        manifest = Manifest.load(folder)
        if (manifest.category, manifest.view) != (self.hparams.category, "complete"):
            raise ManifestError(
                f"{folder}: holds {manifest.view} clouds of {manifest.category}; data.scans takes complete clouds "
                f"of {self.hparams.category}"
            )
        return manifest

    @cached_property
    def _scanned_test_objects(self) -> list[str]:
        """Objects of this set's test split whose scans would teach: they are left out, or the test would flatter."""
        if self.manifest.split_by == "scan":  # of one object, which is in both splits
            return []
        scanned = self._scans.instances["train"]
        tested = self._scans.also_in(self.manifest, "test")
        found = [one for one in scanned if one in tested]
        if len(found) == len(scanned):
            raise ManifestError(
                f"{self.hparams.scans}: all {len(found)} scanned objects are in the test split of {self.folder}, and "
                "would teach what is tested; scan others (of generated ones: another SEED)"
            )
        if found:
            log.warning(
                "%d of %d scanned objects are in the test split of %s; their scans are left out: %s",
                len(found),
                len(scanned),
                self.folder,
                ", ".join(found),
            )
        return found

    def on_before_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Count what training consumes here, where loaders cannot run ahead of it."""
        if self.trainer is not None and self.trainer.training:
            self.consumed_samples += len(batch["sample"]) * self.trainer.world_size
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Lightning saves this in every checkpoint."""
        return {"consumed_samples": self.consumed_samples}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue the training stream where the checkpoint left it."""
        self.consumed_samples = state_dict["consumed_samples"]

    def _loader(self, dataset: ArticulatedDataset, sampler: TrainingStream | EvaluationSampler) -> DataLoader:
        return DataLoader(
            dataset,
            batch_size=self.hparams.batch_size,
            sampler=sampler,
            num_workers=self.hparams.num_workers,
            collate_fn=_identity,
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.hparams.num_workers > 0,
        )

    def _world(self) -> tuple[int, int]:
        """World size and rank."""
        return (1, 0) if self.trainer is None else (self.trainer.world_size, self.trainer.global_rank)

    def _make_command(self) -> str:
        options = self.hparams
        words = [f"make data CAT={options.category} VIEW={options.view}"]
        words += [f"PROTOCOL={options.protocol}"] if options.protocol else []
        words += [f"SOURCE={options.source} ROOT=path/to/it"] if options.source != "procedural" else []
        return " ".join([*words, f"OUT={options.root}"])


def _identity(batch: Batch) -> Batch:
    """`ArticulatedDataset.__getitems__` returns whole batches already."""
    return batch
