"""What has to be run: the data of a category and view, and one job for every method or recipe and seed.

A job is programs that leave notes (`pretrained/stages.py`): it can be killed at any time and done again elsewhere, and
what is finished is not repeated. All lie in one folder that every machine sees, below `<build>/<category>-<view>`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from articulate_ssl.baselines import METHODS
from articulate_ssl.comparison.rows import MULTI_STATE, needs_occupancy, recipe_of
from articulate_ssl.metrics.report import JSON_NAME
from articulate_ssl.pretrained.pack import PROFILES, VIEW_OF_DATA, fit_command, generate_arguments, newest_metrics
from articulate_ssl.pretrained.rebuild import COMPLETE_OPTIONS, DEPTH_OPTIONS, SCANS_OPTIONS, resumed
from articulate_ssl.pretrained.stages import Stage, Workplace
from articulate_ssl.training.checkpoint import load_module
from datamodules.manifest import MANIFEST_NAME, Manifest, ManifestError, set_folder
from datamodules.occupancy import FOLDER, INDEX_NAME

DATA_SEED = 21  # no other: shipped weights and their check are of 11 and 12, README's numbers of 1 to 4
# Of the objects that multi-state trainings know in ten states each, beside the table's clouds: others, so that none of
# them is tested on.
SCANS_SEED = 22
_SCANS = "scans"  # folder of their set, and its stage
OCCUPANCY_SAMPLES = 2048  # of each training cloud
# Configuration files of recipes that need their own, behind the category's and the profile.
RECIPE_CONFIGS = {"paper": (Path("configs/profiles/paper_recipe.yaml"),)}
_SOURCE = "procedural"  # of the set that trains
SAMPLES = 300  # test clouds; chosen: Oracle ICP takes two seconds for each


@dataclass(frozen=True)
class Setting:
    """What is the same for all rows of a table.

    Attributes:
        category: Category name.
        view: `complete` or `partial`.
        build: Folder of everything that is trained.
        root: Folder of the data set.
        samples: Test clouds, spread over instances and states.
        steps: Of each method, in the place of its own; recipes have those of their configuration.
        configs: More configuration files for the recipes, behind the category's and the profile.
        data_options: Words for the generator, if the set does not exist yet.
        test_source: Where other test objects come from, on which the same trainings are tested, too: a set of that
            source, category and view, under `test_root`. None stands for the test split of the set of all.
        test_root: Folder of that set.
    """

    category: str
    view: str
    build: Path
    root: Path
    samples: int = SAMPLES
    steps: int | None = None
    configs: tuple[Path, ...] = ()
    data_options: tuple[str, ...] = ()
    test_source: str | None = None
    test_root: Path | None = None

    @property
    def name(self) -> str:
        """Of the table's files."""
        return f"{self._trained_on}-tested-on-{self.test_source}" if self.test_source else self._trained_on

    @property
    def title(self) -> str:
        """For people."""
        tested = f", tested on objects from {self.test_source}" if self.test_source else ""
        return f"{self.category}, {self.view} clouds{tested}"

    @property
    def folder(self) -> Path:
        """Of the jobs: whatever they are tested on, they are trained once."""
        return self.build / self._trained_on

    @property
    def protocol(self) -> str | None:
        """Of partial views."""
        return "honest" if self.view == "partial" else None

    @property
    def training_set(self) -> Path:
        """Folder of the set that trains and calibrates."""
        return set_folder(self.root, self.category, _SOURCE, self.view, self.protocol)

    @property
    def scans_root(self) -> Path:
        """Where objects lie that multi-state trainings know in several states."""
        return self.folder / _SCANS

    @property
    def scans(self) -> Path:
        """Folder of their set, of complete clouds."""
        return set_folder(self.scans_root, self.category, _SOURCE, "complete", None)

    @property
    def test_set(self) -> Path:
        """Folder of the set that is tested on."""
        if self.test_source is None:
            return self.training_set
        return set_folder(self.test_root or self.root, self.category, self.test_source, self.view, self.protocol)

    @property
    def _trained_on(self) -> str:
        return f"{self.category}-{self.view}"

    @property
    def orientation_range(self) -> float:
        """How far objects are turned, as the recipes' profile of this view says."""
        degrees = 180.0
        for file in PROFILES[VIEW_OF_DATA[self.view]]:
            degrees = yaml.safe_load(Path(file).read_text())["model"].get("orientation_range", degrees)
        return degrees


def make_data(setting: Setting, learners: tuple[str, ...], say: Callable[[str], None]) -> None:
    """Make the set, the occupancy samples and the scans that some learners need, if they are not there.

    Raises:
        StageFailed: if the generator fails.
        ManifestError: if other objects are to be tested on and their set is not there: nobody but the user has them.
    """
    if not (setting.test_set / MANIFEST_NAME).is_file() and setting.test_source is not None:
        raise ManifestError(
            f"{setting.test_set}: no data set here. Make it with: make data CAT={setting.category} VIEW={setting.view} "
            f"SOURCE={setting.test_source} ROOT=<folder of the objects> OUT={setting.test_root or setting.root}"
        )
    if MULTI_STATE in learners and not (setting.scans / MANIFEST_NAME).is_file():
        words = ("--category", setting.category, "--view", "complete", "--seed", str(SCANS_SEED), *SCANS_OPTIONS)
        _generate(setting, _SCANS, words, setting.scans_root, say)
    folder = setting.training_set
    occupancy = needs_occupancy(learners)
    if (folder / MANIFEST_NAME).is_file():
        if not occupancy or (folder / FOLDER / INDEX_NAME).is_file():
            return
        words = generate_arguments(Manifest.load(folder))
    else:
        words = ["--category", setting.category, "--view", setting.view, "--seed", str(DATA_SEED)]
        words += DEPTH_OPTIONS if setting.view == "partial" else COMPLETE_OPTIONS
        words += setting.data_options
    words += ["--occupancy", str(OCCUPANCY_SAMPLES)] if occupancy else []
    _generate(setting, "data", words, setting.root, say)


def _generate(setting: Setting, name: str, words: Sequence[str], out: Path, say: Callable[[str], None]) -> None:
    command = (sys.executable, "-m", "render.generate", *words, "--out", str(out), "--workers", "1")
    Workplace(f"{setting.name}: {name}", setting.folder / "data").run(Stage(name, command), say)


@dataclass(frozen=True)
class Job:
    """The training and test of one learner with one seed.

    Attributes:
        setting: Category, view and effort.
        learner: Its name, of `rows.learners`.
        seed: Of the training.
    """

    setting: Setting
    learner: str
    seed: int

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.setting.name}: {self.learner}, seed {self.seed}"

    @property
    def work(self) -> Workplace:
        """Where its programs run."""
        return Workplace(self.title, self.setting.folder / f"{self.learner}-{self.seed}")

    def stages(self) -> tuple[Stage, ...]:
        """The programs, in their order."""
        return self._method_stages() if self.learner in METHODS else self._recipe_stages()

    def make(self, say: Callable[[str], None] = lambda _line: None) -> None:
        """Do what is not done yet.

        Raises:
            StageFailed: if a program fails; what is finished stays.
        """
        again = False
        for stage in self.stages():
            if self.work.seconds(stage) is not None and not again:
                continue
            go_on = resumed(self._run, self.work.begun(stage)) if stage.name == "fit" else ()
            self.work.run(stage, say, go_on)
            again = True

    @property
    def finished(self) -> bool:
        """Whether all of its programs have come to their end."""
        return all(self.work.seconds(stage) is not None for stage in self.stages())

    def report(self, column: str | None) -> dict[str, Any]:
        """The content of `metrics.json`, of one column of a recipe's, with `parameters` and `train_seconds`."""
        if column is None:
            return json.loads((self._tested / JSON_NAME).read_text())
        path = newest_metrics(self._tested if self.setting.test_source else self._run)
        whole = json.loads(path.read_text())
        fit, *_ = self.stages()
        module = load_module(whole["checkpoint"])
        about = {"parameters": sum(p.numel() for p in module.parameters()), "train_seconds": self.work.seconds(fit)}
        about |= {name: whole[name] for name in ("setting",) if name in whole}
        return {"part_names": whole["part_names"], **whole["columns"][column], **about}

    @property
    def _run(self) -> Path:
        return self.work.folder / "run"

    @property
    def _other_test(self) -> str:
        return f"test-on-{self.setting.test_source}"

    @property
    def _tested(self) -> Path:
        """Where the numbers of a method lie (`baselines.__main__`), and of a recipe on other objects than its set's."""
        source = self.setting.test_source
        return self.work.folder / f"tested-on-{source}" if source else self.work.folder

    def _method_stages(self) -> tuple[Stage, ...]:
        setting = self.setting
        words = [self.learner, "--category", setting.category, "--view", setting.view, "--root", str(setting.root)]
        words += ["--seed", str(self.seed), "--samples", str(setting.samples)]
        words += ["--orientation-range", str(setting.orientation_range), "--out", str(self.work.folder)]
        words += [] if setting.steps is None else ["--steps", str(setting.steps)]
        command = (sys.executable, "-m", "articulate_ssl.baselines", *words)
        if setting.test_source is None:
            return (Stage("method", command),)
        other = ("--test-source", setting.test_source, "--test-root", str(setting.test_root or setting.root))
        return Stage("method", command), Stage(self._other_test, (*command, *other))

    def _recipe_stages(self) -> tuple[Stage, ...]:
        setting, told = self.setting, self.learner == MULTI_STATE
        _, fit, *learn = fit_command(setting.category, VIEW_OF_DATA[setting.view], self.seed, told)
        learn += ["--data.scans", str(setting.scans)] if told else []
        configs = (*RECIPE_CONFIGS.get(self.learner, ()), *setting.configs)
        learn += [word for file in configs for word in ("-c", str(file))]
        learn += ["--model.recipe", recipe_of(self.learner)]
        learn += ["--data.root", str(setting.root), "--data.seed", str(self.seed)]
        learn += ["--data.max_test_samples", str(setting.samples), "--trainer.enable_progress_bar", "false"]
        learn += ["--trainer.default_root_dir", str(self._run)]
        ours = (sys.executable, "-m", "articulate_ssl.cli")
        columns = ("--model.inference.columns", "true")
        stages = (Stage("fit", (*ours, fit, *learn)), Stage("test", (*ours, "test", *learn, *columns)))
        if setting.test_source is None:
            return stages
        other = ("--data.source", setting.test_source, "--data.root", str(setting.test_root or setting.root))
        other += ("--data.calibration_set", str(setting.training_set))
        # The folder of the run stays: the checkpoint is looked up there. What is written goes with the logger.
        other += ("--trainer.logger", "CSVLogger", "--trainer.logger.save_dir", str(self._tested))
        return *stages, Stage(self._other_test, (*ours, "test", *learn, *columns, *other))
