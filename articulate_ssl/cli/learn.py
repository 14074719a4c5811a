"""`lightning fit|validate|test -c configs/<category>.yaml`: Lightning's command line on our module and data."""

from __future__ import annotations

import sys
import warnings
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import LightningCLI

from articulate_ssl.cli import BAD_INPUT
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.inference.checkpoint_file import CheckpointError, read_checkpoint
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.training.module import ArticulatedPoseModule
from datamodules.articulated_data_module import ArticulatedDataModule

IGNORED_WARNINGS = (
    ".*isinstance.treespec, LeafSpec.*",
    ".*does not have many workers.*",
    ".*`tensorboardX` has been removed.*",
    ".*The dirpath has changed.*",
)


class ArticulateCLI(LightningCLI):
    """Lightning's command line, which lets configurations decide and refuses checkpoints that do not fit them."""

    def add_arguments_to_parser(self, parser) -> None:
        """One category for data and model."""
        parser.link_arguments("data.category", "model.category")

    def before_fit(self) -> None:
        """A checkpoint to go on from, if any, must fit."""
        path = self.config_init["fit"].get("ckpt_path")
        if path is not None:
            self._check_checkpoint("fit", path)

    def before_test(self) -> None:
        """Only trained weights are scored."""
        self._use_checkpoint("test")

    def before_validate(self) -> None:
        """Only trained weights are scored."""
        self._use_checkpoint("validate")

    def _parse_ckpt_path(self) -> None:
        """Configurations decide, not what a checkpoint remembers; `_check_checkpoint` compares the two."""

    def _use_checkpoint(self, subcommand: str) -> None:
        """The newest checkpoint where none is given: a bare `lightning test` would score random weights."""
        options = self.config_init[subcommand]
        if options.get("ckpt_path") is None:
            folder = Path(self.trainer.default_root_dir)
            found = sorted(folder.glob("**/checkpoints/*.ckpt"), key=lambda p: p.stat().st_mtime)
            if not found:
                raise CheckpointError(
                    f"lightning {subcommand}: no checkpoint under {folder}; "
                    "run `lightning fit -c …` first, or pass --ckpt_path"
                )
            options["ckpt_path"] = str(found[-1])
        self._check_checkpoint(subcommand, options["ckpt_path"])

    def _check_checkpoint(self, subcommand: str, path: str) -> None:
        """Weights of another category or network would load, or fail obscurely."""
        remembered = read_checkpoint(path)["hyper_parameters"]
        # An option that a checkpoint has never heard of had its default value.
        if asdict(NetworkOptions()) | (remembered.get("network") or {}) != self.model.hparams["network"]:
            raise CheckpointError(
                f"{path}: trained with other network sizes; give `lightning {subcommand}` the same -c files and "
                "--model.network options as `lightning fit`"
            )
        degrees = remembered.get("orientation_range", 180.0)
        if degrees != self.model.orientation.degrees:
            raise CheckpointError(
                f"{path}: trained with --model.orientation_range {degrees:g}, not "
                f"{self.model.orientation.degrees:g}; give `lightning {subcommand}` the same -c files as "
                "`lightning fit` (configs/profiles/depth_camera.yaml sets it)"
            )
        trained_on = remembered.get("category")
        if trained_on != self.model.category:
            raise CheckpointError(
                f"{path}: trained on category {trained_on!r}, but the data are {self.model.category!r}; "
                f"use configs/{trained_on}.yaml or another checkpoint"
            )


def run(arguments: list[str]) -> int:
    """Fit, validate or test, as `arguments` say.

    Returns:
        Exit code: 0, or 2 for a bad configuration, data set or checkpoint, with one message on stderr.
    """
    for message in IGNORED_WARNINGS:
        warnings.filterwarnings("ignore", message)
    torch.set_float32_matmul_precision("high")
    # Lightning reads the command line itself, and hands it to the processes that it starts.
    sys.argv = [sys.argv[0], *arguments]
    try:
        _read_given_checkpoints(arguments)
        ArticulateCLI(
            ArticulatedPoseModule,
            ArticulatedDataModule,
            seed_everything_default=0,
            trainer_defaults={"callbacks": _checkpoint_callbacks()},
            save_config_kwargs={"overwrite": True},
        )
    except (ValueError, DiscoveryError) as error:
        print(f"lightning: {error}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _read_given_checkpoints(arguments: list[str]) -> None:
    """Refuse a checkpoint that cannot be read before the rest of the command line is looked at."""
    for flag, value in pairwise(arguments):
        if flag == "--ckpt_path":
            read_checkpoint(value)


def _checkpoint_callbacks() -> list[Callback]:
    return [
        ModelCheckpoint(filename="final-{step}"),
        ModelCheckpoint(filename="{step}", every_n_train_steps=200, save_last=True),
    ]
