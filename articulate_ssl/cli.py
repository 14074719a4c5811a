"""The command line: `lightning fit|validate|test -c configs/<category>.yaml`, and `lightning predict CLOUD --ckpt …`.

Both console scripts, `lightning` and `articulate-ssl`, are this program.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code: 0, or 2 for bad arguments or bad input (one message, no traceback)."""
    from articulate_ssl.ops.denormals import flush_denormals

    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with flush_denormals():
        if arguments[:1] == ["predict"]:
            return _predict(arguments[1:])
        return _learn(arguments)


def _predict(arguments: list[str]) -> int:
    import argparse

    from articulate_ssl.inference import predict_command

    parser = argparse.ArgumentParser(
        prog="lightning predict", description="Parts, poses and joints of the object in one scan."
    )
    predict_command.add_arguments(parser)
    return predict_command.run(parser.parse_args(arguments))


def _learn(arguments: list[str]) -> int:
    import warnings

    import torch
    from lightning.pytorch.callbacks import ModelCheckpoint
    from lightning.pytorch.cli import LightningCLI

    from articulate_ssl.inference.checkpoint_file import CheckpointError, read_checkpoint
    from articulate_ssl.module import ArticulatedPoseModule
    from articulate_ssl.options import NetworkOptions
    from articulate_ssl.recipes.part_discovery import DiscoveryError
    from datamodules.articulated_data_module import ArticulatedDataModule

    warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.*")
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*`tensorboardX` has been removed.*")
    warnings.filterwarnings("ignore", ".*The dirpath has changed.*")
    torch.set_float32_matmul_precision("high")

    class ArticulateCLI(LightningCLI):
        def add_arguments_to_parser(self, parser) -> None:
            parser.link_arguments("data.category", "model.category")

        def _parse_ckpt_path(self) -> None:
            """Configurations decide, not what a checkpoint remembers; `_use_checkpoint` compares the two."""

        def _use_checkpoint(self, subcommand: str) -> None:
            """Only trained weights are scored: a bare `lightning test` would score random ones."""
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

        def before_fit(self) -> None:
            path = self.config_init["fit"].get("ckpt_path")
            if path is not None:
                self._check_checkpoint("fit", path)

        def before_test(self) -> None:
            self._use_checkpoint("test")

        def before_validate(self) -> None:
            self._use_checkpoint("validate")

    sys.argv = [sys.argv[0], *arguments]
    try:
        for flag, value in pairwise(arguments):
            if flag == "--ckpt_path":
                read_checkpoint(value)
        ArticulateCLI(
            ArticulatedPoseModule,
            ArticulatedDataModule,
            seed_everything_default=0,
            trainer_defaults={
                "callbacks": [
                    ModelCheckpoint(filename="final-{step}"),
                    ModelCheckpoint(filename="{step}", every_n_train_steps=200, save_last=True),
                ]
            },
            save_config_kwargs={"overwrite": True},
        )
    except (ValueError, DiscoveryError) as error:
        print(f"lightning: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
