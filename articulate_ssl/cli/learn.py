"""`lightning fit|validate|test -c configs/<category>.yaml`: Lightning's command line on our module and data.

What the command line leaves open, `cli.unsaid` decides. `--wandb [PROJECT]` logs to Weights & Biases as well.
"""

from __future__ import annotations

import signal
import sys
import warnings
from dataclasses import asdict
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException, SIGTERMException

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
from articulate_ssl.training.model import JOINT_TYPES, ArticulatedPoseModel
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
# Options of the model without which weights do not fit, or mean something else, and their defaults.
_OF_WEIGHTS = {
    name: signature(ArticulatedPoseModel).parameters[name].default
    for name in ("num_parts", "joint_type", "state_range", "recipe", "orientation_range")
}


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
        self._check_parts("fit")

    def before_test(self) -> None:
        """Only trained weights are scored."""
        self._use_checkpoint("test")
        self._check_parts("test")

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
        trained_on = remembered.get("category")
        if trained_on != self.model.category:
            raise CheckpointError(
                f"{path}: trained on category {trained_on!r}, but the data are {self.model.category!r}; "
                f"use configs/{trained_on}.yaml or another checkpoint"
            )
        other = _other_model(remembered, self.model.hparams)
        if other is not None:
            name, theirs, ours = other
            raise CheckpointError(
                f"{path}: trained with --model.{name} {theirs}, not {ours}; give `lightning {subcommand}` the same -c "
                "files and options as `lightning fit` (of profiles, depth_camera.yaml sets orientation_range, "
                "paper_recipe.yaml recipe and rigid_steps)"
            )

    def _check_parts(self, subcommand: str) -> None:
        """Parts and joints of the model and of the labels: without labels, any number can be looked for."""
        manifest, model = self.datamodule.manifest, self.model.hparams
        problem = None
        if len(manifest.part_names) != model["num_parts"]:
            problem = f"{len(manifest.part_names)} parts, and --model.num_parts is {model['num_parts']}"
        elif JOINT_TYPES[model["joint_type"]] not in manifest.joint_types:
            problem = f"no {model['joint_type']} joint, as --model.joint_type says"
        if problem is not None and manifest.labelled:
            said = f"{self.datamodule.folder}: labels have {problem}"
            if subcommand == "test":
                raise CheckpointError(f"{said}; nothing can be scored: leave -c out, or name the set it was trained on")
            print(f"lightning {subcommand}: {said}: `lightning test` will refuse to score that", file=sys.stderr)

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
    except (ValueError, DiscoveryError, MisconfigurationException) as error:
        print(f"lightning: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        if error.errno is None:
            raise
        print(f"lightning: {error} (runs are written to --trainer.default_root_dir)", file=sys.stderr)
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


def _other_model(remembered: dict[str, Any], now: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """An option that weights depend on, of a checkpoint and of the model: the first that differs."""
    for name, default in _OF_WEIGHTS.items():
        # An option that a checkpoint has never heard of had its default value.
        theirs, ours = remembered.get(name, default), now[name]
        if theirs != ours:
            return name, theirs, ours
    theirs, ours = ((some.get("schedule") or {}).get("rigid_steps", 0) for some in (remembered, now))
    return ("schedule.rigid_steps", theirs, ours) if bool(theirs) != bool(ours) else None


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
