"""`lightning fit|validate|test -c configs/<category>.yaml`: Lightning's command line on our module and data.

What the command line leaves open, `cli.unsaid` decides. `--wandb [PROJECT]` logs to Weights & Biases as well.
"""

from __future__ import annotations

import signal
import sys
import warnings
from dataclasses import asdict
from pathlib import Path

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from lightning.pytorch.utilities.exceptions import SIGTERMException

from articulate_ssl.cli import BAD_INPUT
from articulate_ssl.cli.unsaid import completed, given_option, newest_checkpoint
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.inference.checkpoint_file import CheckpointError, read_checkpoint
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.training.callbacks.duration import EstimateDuration
from articulate_ssl.training.callbacks.keep_last import KeepLast
from articulate_ssl.training.callbacks.show_progress import ShowProgress
from articulate_ssl.training.callbacks.test_results import SendTestResults
from articulate_ssl.training.module import ArticulatedPoseModule
from datamodules.articulated_data_module import ArticulatedDataModule

IGNORED_WARNINGS = (
    ".*isinstance.treespec, LeafSpec.*",
    ".*does not have many workers.*",
    ".*`tensorboardX` has been removed.*",
    ".*The dirpath has changed.*",
)


WANDB_PROJECT = "articulate-ssl"  # where --wandb names none
TERMINATED = 128 + signal.SIGTERM  # the exit code, as a shell has it
_CHECKPOINT_STEPS = 200  # between checkpoints


class ArticulateCLI(LightningCLI):
    """Lightning's command line, which lets configurations decide and refuses checkpoints that do not fit them."""

    def add_arguments_to_parser(self, parser) -> None:
        """One category for data and model, and a flag for Weights & Biases."""
        parser.link_arguments("data.category", "model.category")
        parser.add_argument(
            "--wandb",
            type=str,
            nargs="?",
            const=WANDB_PROJECT,
            default=None,
            metavar="PROJECT",
            help=f"log curves and pictures to Weights & Biases too (default project: {WANDB_PROJECT}); "
            "WANDB_MODE=offline needs no account",
        )

    def before_instantiate_classes(self) -> None:
        """The flag is of this command: a run's saved configuration must not send anything later."""
        options = self.config[self.subcommand]
        self.wandb_project, options["wandb"] = options.get("wandb"), None

    def instantiate_trainer(self, **options) -> Trainer:
        """With Weights & Biases beside the loggers that there are, if asked for."""
        if self.wandb_project:
            options["logger"] = self._loggers()
        return super().instantiate_trainer(**options)

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
            found = newest_checkpoint(folder)
            if found is None:
                raise CheckpointError(
                    f"lightning {subcommand}: no checkpoint under {folder}; "
                    "run `lightning fit -c …` first, or pass --ckpt_path"
                )
            options["ckpt_path"] = str(found)
        self._check_checkpoint(subcommand, options["ckpt_path"])

    def _check_checkpoint(self, subcommand: str, path: str) -> None:
        """Weights of another category or network would load, or fail obscurely."""
        remembered = read_checkpoint(path)["hyper_parameters"]
        # An option that a checkpoint has never heard of had its default value.
        if asdict(NetworkOptions()) | (remembered.get("network") or {}) != self.model.hparams["network"]:
            raise CheckpointError(
                f"{path}: trained with other network sizes; leave -c out, which takes its run's own configuration, or "
                f"give `lightning {subcommand}` the same -c files and --model.network options as `lightning fit` "
                "(with configs/profiles/paper.yaml if that had a GPU and this machine has none)"
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

    def _loggers(self) -> list[Logger]:
        """The first decides about the run's folder, as without the flag."""
        options = self.config_init[self.subcommand]["trainer"]
        root = Path(options.get("default_root_dir") or ".")
        root.mkdir(parents=True, exist_ok=True)  # or wandb writes to a temporary folder
        given = options.get("logger")
        loggers = [CSVLogger(root)] if given in (None, True) else given or []
        wandb = WandbLogger(
            project=self.wandb_project,
            save_dir=root,
            group=self.model.category,
            job_type=self.subcommand,
            config=self.config_dump,
        )
        return [*(loggers if isinstance(loggers, list) else [loggers]), wandb]


@flush_denormals()
def run(arguments: list[str]) -> int:
    """Fit, validate or test, as `arguments` say.

    Returns:
        Exit code: 0; 2 for a bad configuration, data set or checkpoint, with one message on stderr; 143 if SIGTERM
        ended it.
    """
    for message in IGNORED_WARNINGS:
        warnings.filterwarnings("ignore", message)
    torch.set_float32_matmul_precision("high")
    try:
        _read_given_checkpoint(arguments)
        arguments, notes = completed(arguments)
        for note in notes:
            print(f"lightning {arguments[0]}: {note}", file=sys.stderr)
        # Lightning reads the command line itself, and hands it to the processes that it starts.
        sys.argv = [sys.argv[0], *arguments]
        ArticulateCLI(
            ArticulatedPoseModule,
            ArticulatedDataModule,
            seed_everything_default=0,
            trainer_defaults={"callbacks": _callbacks()},
            save_config_kwargs={"overwrite": True},
        )
    except (ValueError, DiscoveryError) as error:
        print(f"lightning: {error}", file=sys.stderr)
        return BAD_INPUT
    except SIGTERMException:  # a SystemExit without a code: whoever waits for the end would take it for success
        print(f"lightning {arguments[0]}: terminated", file=sys.stderr)
        return TERMINATED
    except Exception as error:
        # By name, because nothing of wandb is imported without its flag.
        if not type(error).__module__.startswith("wandb."):
            raise
        print(f"lightning: Weights & Biases: {error} (without an account: WANDB_MODE=offline)", file=sys.stderr)
        return BAD_INPUT
    return 0


def _read_given_checkpoint(arguments: list[str]) -> None:
    """Refuse a checkpoint that cannot be read before the rest of the command line is looked at."""
    path = given_option(arguments, "--ckpt_path")
    if path is not None:
        read_checkpoint(path)


def _callbacks() -> list[Callback]:
    return [
        ModelCheckpoint(filename="final-{step}"),
        ModelCheckpoint(filename="{step}", every_n_train_steps=_CHECKPOINT_STEPS, save_last=True),
        KeepLast(),
        EstimateDuration(),
        ShowProgress(),
        SendTestResults(),
    ]
