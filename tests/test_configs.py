"""Every recipe and profile loads through the command line, and says what the category's specification says."""

from __future__ import annotations

import math
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from articulate_ssl.cli import main
from render.camera import look_at_rotation
from render.category import category_names, load_category

CONFIGS = Path(__file__).parent.parent / "configs"
CATEGORIES = ("desk_lamp", "drawer", "eyeglasses", "laptop", "laptop_real", "oven", "safe", "washing_machine")
PROFILES = (
    (),
    ("cpu",),
    ("gpu",),
    ("paper",),
    ("cpu", "smoke"),
    ("cpu", "depth_camera"),
    ("cpu", "paper_recipe"),
    ("cpu", "multi_state"),
    ("cpu", "depth_camera", "depth_from_scans"),
)


@pytest.fixture(autouse=True)
def keep_argv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lightning"])


def printed_config(paths: list[Path], capsys: pytest.CaptureFixture[str]) -> dict:
    """What `lightning fit` would run with."""
    options = [word for path in paths for word in ("-c", str(path))]
    with pytest.raises(SystemExit) as exit_:
        main(["fit", *options, "--print_config"])
    assert exit_.value.code in (0, None)
    return yaml.safe_load(capsys.readouterr().out)


def test_there_is_one_recipe_for_every_category() -> None:
    assert {path.stem for path in CONFIGS.glob("*.yaml")} == set(CATEGORIES) == set(category_names()) - {"articulated"}


def test_every_profile_is_tested() -> None:
    tested = {name for names in PROFILES for name in names}
    assert tested == {path.stem for path in (CONFIGS / "profiles").glob("*.yaml")}


@pytest.mark.parametrize("category", CATEGORIES)
def test_recipe_agrees_with_category(category: str, capsys: pytest.CaptureFixture[str]) -> None:
    config = printed_config([CONFIGS / f"{category}.yaml"], capsys)
    spec = load_category(category)
    model = config["model"]
    assert config["data"]["category"] == category
    assert model["num_parts"] == len(spec.parts)
    assert {model["joint_type"]} == {joint["type"] for joint in _raw_spec(category)["joints"]}
    ranges = [joint["range_deg"] for joint in _raw_spec(category)["joints"] if "range_deg" in joint]
    if ranges:
        widest = max(upper - lower for lower, upper in ranges)
        assert model["state_range"] == pytest.approx(math.radians(widest), abs=1e-3)
    assert Path(config["trainer"]["default_root_dir"]) == Path("runs") / category


def _raw_spec(category: str) -> dict:
    return yaml.safe_load((CONFIGS.parent / "render" / "categories" / f"{category}.yaml").read_text())


@pytest.mark.parametrize("profiles", PROFILES, ids="+".join)
def test_profiles_overlay_a_recipe(profiles: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    overlays = [CONFIGS / "profiles" / f"{name}.yaml" for name in profiles]
    config = printed_config([CONFIGS / "laptop.yaml", *overlays], capsys)
    for path in overlays[-1:]:
        for section, values in yaml.safe_load(path.read_text()).items():
            for key, value in values.items():
                _assert_contains(config[section][key], value)
    schedule = config["model"]["schedule"]
    assert schedule["steps"] == config["trainer"]["max_steps"]
    assert schedule["rigid_steps"] + schedule["warmup_steps"] <= schedule["steps"]


def test_the_depth_camera_profile_covers_the_views_of_every_category() -> None:
    limit = yaml.safe_load((CONFIGS / "profiles" / "depth_camera.yaml").read_text())["model"]["orientation_range"]
    for category in CATEGORIES:
        view = _raw_spec(category)["view"]
        bounds = [np.deg2rad(view[f"{angle}_deg"]) for angle in ("azimuth", "elevation", "roll")]
        corners = Rotation.from_matrix([look_at_rotation(*angles) for angles in product(*bounds)])
        farthest = (corners.mean().inv() * corners).magnitude().max()
        assert np.rad2deg(farthest) < limit, category


def _assert_contains(whole: object, part: object) -> None:
    if isinstance(part, dict):
        for key, value in part.items():
            _assert_contains(whole[key], value)
    else:
        assert whole == part


@pytest.mark.parametrize(
    ("section", "key"),
    [("data", "num_pionts"), ("model", "num_prats"), ("model.schedule", "learning_rat"), ("trainer", "max_stpes")],
)
def test_misspelt_key_is_named(section: str, key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    misspelt: dict = {key: 7}
    for name in reversed(section.split(".")):
        misspelt = {name: misspelt}
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text(yaml.safe_dump(misspelt))
    with pytest.raises(SystemExit) as exit_:
        main(["fit", "-c", str(CONFIGS / "laptop.yaml"), "-c", str(overlay)])
    assert exit_.value.code == 2
    message = capsys.readouterr().err
    assert key in message
    assert "Traceback" not in message
