"""Which clouds show the same object reaches discovery where it is asked for, and nothing else of the labels does."""

import json
from dataclasses import replace

import pytest
import torch
from synthetic import write_synthetic_set
from tiny import DISCOVERY, POINTS, fit, quiet_trainer, tiny_data, tiny_module
from torch.nn import functional
from unlabelled import without_labels

from articulate_ssl.discovery.from_scans import StandingScans
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.losses.objective import ObjectiveOptions
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.training.lying_scans import quarters_to_stand
from articulate_ssl.training.recipes import staged
from articulate_ssl.training.set_clouds import SetClouds
from datamodules.manifest import ManifestError

GROUPED = replace(DISCOVERY, clouds=18, grouped=True)
VIEWS = ObjectiveOptions(unidirectional=True)


@pytest.fixture
def seen(monkeypatch):
    """What discovery is given; what it finds is some shape."""
    calls = {}

    def grouped(clouds, scans, instance, *category):
        calls["grouped"] = clouds, scans, instance, *category
        return _some_shape(clouds)

    def single(clouds, *rest):
        calls["single"] = clouds, *rest
        return _some_shape(clouds)

    monkeypatch.setattr(staged, "discover_grouped", grouped)
    monkeypatch.setattr(staged, "discover", single)
    return calls


def _some_shape(clouds):
    """Whose registrations are the better, the later the cloud."""
    count = len(clouds)
    joints = Joints(KinematicChain(2, 0, (0,), (1,)), torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1, 3), REVOLUTE)
    shape = ArticulatedShape(clouds[0], torch.arange(clouds.shape[1]) % 2, joints)
    state, stretch = torch.linspace(-1, 1, count)[:, None], torch.zeros(count, 2, 3)
    return RegisteredShape(shape, torch.eye(4).repeat(count, 1, 1), state, stretch, -torch.arange(float(count)))


def _object_of(root, clouds):
    """The object that each cloud shows, by its points: no rotation changes their distances to the origin."""
    batches = list(tiny_data(root).discovery_dataloader(99))
    stored = torch.cat([batch["dense_points"] for batch in batches]).norm(dim=-1)
    nearest = torch.cdist(clouds.norm(dim=-1), stored).argmin(dim=1)
    return torch.cat([batch["instance"] for batch in batches])[nearest]


@pytest.mark.parametrize("labelled", [True, False])
def test_which_object_a_cloud_shows_reaches_discovery(tmp_path, seen, labelled):
    folder = write_synthetic_set(tmp_path, states=9)
    if not labelled:
        without_labels(folder)
    module = tiny_module(discovery=GROUPED)
    fit(module, tmp_path, 1)
    assert seen.keys() == {"grouped"}
    assert not module.view_search.learnt
    clouds, scans, instance, *category = seen["grouped"]
    assert category == [2, module.articulated.joint_type, GROUPED]
    assert scans.shape == (18, 128, 3) and scans.dtype == torch.float32
    assert torch.equal(instance, _object_of(tmp_path, scans))
    assert instance.unique(return_counts=True)[1].tolist() == [9, 9]  # whole objects
    # Of the clouds that single-cloud discovery sees, the three quarters that were registered best are handed over.
    assert len(_object_of(tmp_path, clouds).unique()) > 2
    assert torch.equal(module.recipe.found.points, clouds.flip(0)[:13, :POINTS])


def test_unless_it_is_asked_for_discovery_is_given_single_clouds(tmp_path, seen):
    write_synthetic_set(tmp_path)
    module = tiny_module()
    fit(module, tmp_path, 1)
    assert seen.keys() == {"single"}
    clouds, *rest = seen["single"]
    assert rest == [2, module.articulated.joint_type, DISCOVERY, module.estimator.observation]
    expected = torch.cat([batch["dense_points"] for batch in tiny_data(tmp_path).discovery_dataloader(6)])
    assert torch.equal(clouds, expected)


@pytest.mark.parametrize("grouped", [True, False])
def test_a_test_names_the_setting(tmp_path, grouped):
    write_synthetic_set(tmp_path)
    module = tiny_module(discovery=replace(DISCOVERY, grouped=grouped))
    quiet_trainer(tmp_path).test(module, tiny_data(tmp_path), verbose=False)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics.get("setting") == ("multi-state" if grouped else None)


def test_depth_views_whose_hidden_sides_would_count_are_refused_at_once():
    tiny_module(discovery=GROUPED, orientation_range=100.0, objective=VIEWS)
    with pytest.raises(ValueError, match=r"add objective\.unidirectional true"):
        tiny_module(discovery=GROUPED, orientation_range=100.0)


def test_depth_views_are_refused_when_training_starts(tmp_path):
    write_synthetic_set(tmp_path, view="partial", protocol="honest")
    for objective in (ObjectiveOptions(), VIEWS):
        with pytest.raises(ValueError, match=r"grouped needs complete clouds, and .* holds depth views.*data\.scans"):
            fit(tiny_module(discovery=GROUPED, objective=objective), tmp_path, 1, view="partial", protocol="honest")


def test_views_are_taught_by_scans_of_the_category(tmp_path, monkeypatch):
    """Depth views, scans and their objects reach discovery; the views that it hands over are not turned."""
    write_synthetic_set(tmp_path / "views", view="partial", protocol="honest")
    scans = write_synthetic_set(tmp_path / "scans", states=9)
    given = {}

    def from_scans(views, clouds, objects, instance, *rest, to_stand):
        assert to_stand is quarters_to_stand
        given["all"] = views, clouds, objects, instance
        given["rest"], given["times"] = rest, given.get("times", 0) + 1
        standing = StandingScans(
            clouds, torch.arange(len(clouds)), _some_shape(clouds), torch.eye(3).expand(len(clouds), 3, 3, 3), 0.3
        )
        return clouds[:4, :POINTS], replace(_some_shape(clouds[:4]), point_part=parts), standing

    parts = torch.randint(2, (4, POINTS), generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(staged, "discover_from_scans", from_scans)
    module = tiny_module(discovery=GROUPED, objective=VIEWS, orientation_range=100.0)
    fit(module, tmp_path / "views", 1, view="partial", protocol="honest", scans=str(scans))
    views, clouds, objects, instance = given["all"]
    stored = list(tiny_data(tmp_path / "views", view="partial", protocol="honest").discovery_dataloader(18))
    assert torch.equal(views, torch.cat([batch["dense_points"] for batch in stored]))
    assert len(clouds) == 18 and torch.equal(instance, _object_of(tmp_path / "scans", objects))
    assert given["rest"][-2:] == (module.orientation, POINTS)
    points, target = module.recipe._registered_clouds(5, torch.Generator().manual_seed(0), torch.device("cpu"))
    assert all((one == module.recipe.found.points).all(dim=(1, 2)).any() for one in points)
    assert torch.equal(target.base[:, :3, :3], torch.eye(3).expand(5, 3, 3))
    # A search among them decides which way round views are.
    kept = module.view_search.views * module.view_search.step[:, None, None]
    torch.testing.assert_close(
        kept, module.recipe.found.points, atol=float(module.view_search.step.max()) / 2, rtol=1e-4
    )
    assert torch.equal(module.view_search.state, module.recipe.found.state)
    assert torch.equal(module.view_search.part.long(), parts)
    # Whose part is known counts for it, whatever lies nearer; the checkpoint keeps it.
    which = (points[:, None] == module.recipe.found.points).all(dim=(2, 3)).int().argmax(dim=1)
    assert torch.equal(target.point_part, parts[which])
    outcome = module.recipe._warmup_step(points, torch.Generator().manual_seed(0))
    assert torch.equal(outcome.terms.association, functional.one_hot(parts[which], 2).float())
    again = tiny_module(discovery=GROUPED, objective=VIEWS, orientation_range=100.0)
    again.recipe.restore(module.recipe.kept())
    assert torch.equal(again.recipe.found.point_part, parts)
    # Scans stay at hand; a checkpoint does not keep them, so another run finds them anew. Their hinges are found once.
    known = {}

    def by_own_scans(found, clouds, instance, scans, of_object, options):
        known["times"] = known.get("times", 0) + 1
        known["all"] = clouds, instance, scans, of_object
        assert options is module.recipe.discovery or options is again.recipe.discovery
        return replace(found, state=found.state + 1)

    monkeypatch.setattr(staged, "by_own_scans", by_own_scans)
    data = SetClouds(tiny_data(tmp_path / "views", view="partial", protocol="honest", scans=str(scans)))
    assert torch.equal(module.recipe.standing_scans(data, POINTS).clouds, clouds) and given["times"] == 1
    assert torch.equal(again.recipe.standing_scans(data, POINTS).clouds, clouds) and given["times"] == 2
    standing = again.recipe.standing_scans(data, POINTS)
    assert given["times"] == 2 == known["times"] and torch.equal(standing.found.state, _some_shape(clouds).state + 1)
    shown, instance, every, of_object = known["all"]
    assert torch.equal(instance, _object_of(tmp_path / "scans", shown))
    assert torch.equal(of_object, _object_of(tmp_path / "scans", every)) and len(every) > len(shown)


def test_scans_of_another_category_or_view_are_refused(tmp_path):
    views = write_synthetic_set(tmp_path, view="partial", protocol="honest")
    with pytest.raises(ManifestError, match=r"holds partial clouds of laptop; data\.scans takes complete clouds of"):
        module = tiny_module(discovery=GROUPED, objective=VIEWS)
        fit(module, tmp_path, 1, view="partial", protocol="honest", scans=str(views))
