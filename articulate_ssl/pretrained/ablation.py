"""What each thing that shipped weights have learnt after training is worth: the same clouds without it.

Nothing is trained anew. Of weights that are loaded again one thing is left out, the rest stays as it was learnt with
it, and what is predicted is calibrated and tested as ever. So a row says what is lost if one thing goes, not what
would be learnt without it. Or it is the network that goes, or registration (`training.columns`). Objects are of a data
seed of their own: those of the card are for the card. Or they are of a labelled set that the card knows nothing of, as
what closed doors taught says nothing about open ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.pretrained.check import data_of, make_data, tested
from articulate_ssl.pretrained.elsewhere import labelled_set
from articulate_ssl.pretrained.markdown_table import cells_of, table_of
from articulate_ssl.pretrained.study import WeightsStudy
from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.columns import SECONDS, TITLES
from articulate_ssl.training.module import ArticulatedPoseModule
from articulate_ssl.training.weights_card import WeightsCard
from datamodules.articulated_data_module import ArticulatedDataModule

NOTHING = "nothing"


@dataclass(frozen=True)
class Ablation:
    """One thing to leave out.

    Attributes:
        name: Of it, for tables.
        known: Whether weights have it.
        forget: Leaves it out.
    """

    name: str
    known: Callable[[PoseEstimator], bool]
    forget: Callable[[PoseEstimator], None]


def _no_sides(estimator: PoseEstimator) -> None:
    estimator.hinge_sides.learnt.fill_(False)
    estimator.hinge_sides.camera.forget()


def _no_decision(estimator: PoseEstimator) -> None:
    estimator.two_ways.learnt.fill_(False)
    _no_network_that_decides(estimator)


def _no_proportions(estimator: PoseEstimator) -> None:
    estimator.final.cycles = 0


def _no_network_that_decides(estimator: PoseEstimator) -> None:
    estimator.two_ways.surface = estimator.two_ways.near = None


def _no_network_from_near(estimator: PoseEstimator) -> None:
    estimator.two_ways.near = None


def _no_network_of_turns(estimator: PoseEstimator) -> None:
    estimator.sliding.surface = None


def _no_network_of_view_turns(estimator: PoseEstimator) -> None:
    estimator.object_frame.surface = None


def _no_network_of_parts(estimator: PoseEstimator) -> None:
    estimator.sliding.parts = None


def _no_network_of_poses(estimator: PoseEstimator) -> None:
    estimator.pose_network.network = None


def _no_network_of_box_turns(estimator: PoseEstimator) -> None:
    estimator.box_turns.surface = None


def _no_free_space(estimator: PoseEstimator) -> None:
    estimator.other_views.reaches = 0.0


def _no_contact(estimator: PoseEstimator) -> None:
    estimator.inference = replace(estimator.inference, closed_contact=False)


def _no_network_of_views_parts(estimator: PoseEstimator) -> None:
    estimator.view_search.parts = None


ABLATIONS = (
    Ablation(NOTHING, lambda _: True, lambda _: None),
    Ablation("the network that sees parts from near", lambda of: of.two_ways.near is not None, _no_network_from_near),
    Ablation(
        "networks that decide which way round",
        lambda of: of.two_ways.surface is not None,
        _no_network_that_decides,
    ),
    Ablation("relief and these networks", lambda of: bool(of.two_ways.learnt), _no_decision),
    Ablation(
        "the network that chooses among leading turns", lambda of: of.sliding.surface is not None, _no_network_of_turns
    ),
    Ablation(
        "the network that says parts, by votes instead", lambda of: of.sliding.parts is not None, _no_network_of_parts
    ),
    Ablation("the search in the collection", lambda of: of.sliding.learnt, lambda of: of.sliding.forget()),
    Ablation("the search among simulated views", lambda of: of.view_search.learnt, lambda of: of.view_search.forget()),
    Ablation(
        "the network that says parts of views",
        lambda of: of.view_search.parts is not None,
        _no_network_of_views_parts,
    ),
    Ablation(
        "the network that chooses among turns of views",
        lambda of: of.object_frame.surface is not None,
        _no_network_of_view_turns,
    ),
    Ablation("the network that says poses", lambda of: of.pose_network.learnt, _no_network_of_poses),
    Ablation("which way round boxes look right", lambda of: of.box_turns.surface is not None, _no_network_of_box_turns),
    Ablation(
        "training clouds that boxes are like",
        lambda of: of.box_turns.alike.learnt,
        lambda of: of.box_turns.alike.forget(),
    ),
    Ablation("views of closed doors", lambda of: of.closed_views.learnt, lambda of: of.closed_views.forget()),
    Ablation("free space", lambda of: of.other_views.every_way and bool(of.other_views.reaches), _no_free_space),
    Ablation("fronts of drawers", lambda of: of.front_ends.learnt, lambda of: of.front_ends.forget()),
    Ablation(
        "how views are square, and these networks",
        lambda of: of.object_frame.learnt,
        lambda of: of.object_frame.forget(),
    ),
    Ablation("where closed doors lie on bodies", lambda of: of.closes, _no_contact),
    Ablation("which side is up", lambda of: bool(of.hinge_sides.learnt), _no_sides),
    Ablation("mirror images", lambda of: bool(of.handedness.learnt), lambda of: of.handedness.learnt.fill_(False)),
    Ablation("joint limits", lambda of: of.states.learnt, lambda of: of.states.forget()),
    Ablation(
        "faces, and the common shape", lambda of: of.part_frames.learnt, lambda of: of.part_frames.flat.fill_(False)
    ),
    Ablation("the common shape", lambda of: of.common_shape.learnt, lambda of: of.common_shape.forget()),
    Ablation("the cloud's own proportions, and all that builds on them", lambda of: of.final.fits, _no_proportions),
)


@dataclass(frozen=True)
class Study(WeightsStudy):
    """What things are worth that weights have learnt, and the network, and registration.

    Attributes:
        elsewhere: Source and folder of a labelled set to test on (`pretrained.elsewhere`); None is clouds of the seed,
            as the card's are, which else only calibrate.
    """

    elsewhere: tuple[str, Path] | None = None

    def run(self, say: Callable[[str], None]) -> list[tuple[str, dict[str, Any]]]:
        """What is left out, and the content of `metrics.json` without it.

        Raises:
            CheckpointError: if the weights have no card, the seed is the card's own, or no data can be made.
            ManifestError: if there is no such labelled set, or it is damaged, or has no labels.
        """
        card, place = self._with_data(say)
        estimator = load_module(self.weights.file).estimator
        found = []
        for ablation in (one for one in ABLATIONS if one.known(estimator)):
            say(f"{self.weights.name}: without {ablation.name} …")
            metrics = self._tested(f"without {ablation.name}", _without(ablation), card, place)
            found.append((ablation.name, metrics))
        return found

    def columns(self, say: Callable[[str], None]) -> list[tuple[str, dict[str, Any]]]:
        """What predicts, as `lightning test --model.inference.columns true` names it, and its metrics.

        Raises:
            CheckpointError, ManifestError: as `run`.
        """
        card, place = self._with_data(say)
        say(f"{self.weights.name}: no network, network alone, both …")
        metrics = self._tested("columns", _in_columns, card, place)
        return [(TITLES[name], column) for name, column in metrics["columns"].items()]

    def _with_data(self, say: Callable[[str], None]) -> tuple[WeightsCard, Path]:
        card, place = self.card(), self.build / f"{self.weights.name}-seed-{self.seed}"
        self._data(card, place)  # a set that is not there is refused before clouds are generated
        self.made(place, lambda: make_data(card, self.seed, place), say)
        return card, place

    def _tested(
        self, name: str, change: Callable[[ArticulatedPoseModule], None], card: WeightsCard, place: Path
    ) -> dict[str, Any]:
        """The content of `metrics.json` of weights that something was changed of, unless it is known."""
        data, about = self._data(card, place), ()
        if self.elsewhere is not None:
            place, about = place / f"on-{self.elsewhere[0]}", (str(data.folder.resolve()), data.manifest)

        def measure() -> dict[str, Any]:
            module = load_module(self.weights.file)
            change(module)
            return tested(module, data, place)

        return self.kept(place / f"{name}.json", measure, *about)

    def _data(self, card: WeightsCard, place: Path) -> ArticulatedDataModule:
        """To test on."""
        generated = data_of(card, place / "data", load_module(self.weights.file).num_points, self.samples)
        return generated if self.elsewhere is None else labelled_set(*self.elsewhere, generated, self.samples)


def _without(ablation: Ablation) -> Callable[[ArticulatedPoseModule], None]:
    return lambda module: ablation.forget(module.estimator)


def _in_columns(module: ArticulatedPoseModule) -> None:
    module.inference = replace(module.inference, columns=True)


def as_markdown(found: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """A table, a row for each thing that was left out."""
    return table_of("without", [[name, *cells_of(metrics)] for name, metrics in found])


def columns_as_markdown(found: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """A table, a row for each way to predict, with its seconds for a cloud."""
    rows = [[name, *cells_of(metrics), f"{metrics[SECONDS]:.2f}"] for name, metrics in found]
    return table_of("what predicts", rows, "s / cloud")
