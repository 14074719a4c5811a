"""The contact sheet and its command line."""

import numpy as np
import pytest
from PIL import Image

from render.category import load_category
from render.preview import COLUMNS, contact_sheet, main
from render.sources import open_source


def test_contact_sheet_shows_instances_states_and_clouds():
    spec = load_category("drawer")
    source = open_source("procedural", spec, None, 0)
    instance = spec.to_rest(source.load("drawer-0000"))
    figure = contact_sheet(spec, [instance], seed=0)
    rest, states, clouds = np.array(figure.axes).reshape(3, COLUMNS)
    assert [len(axes.images) for axes in rest] == [1, 0, 0, 0, 0, 0]
    assert rest[0].get_title() == "drawer-0000"
    assert all(len(axes.images) == 1 and len(axes.texts) == 3 for axes in states)  # an arrow for every joint
    travel = round(100 * instance.joints[0].upper)
    assert states[2].get_title() == f"{travel} cm, {travel} cm, {travel} cm"
    for axes in clouds:
        (points,) = axes.collections
        assert len(np.unique(points.get_facecolors(), axis=0)) == instance.num_parts
        assert np.abs(points.get_offsets()).max() < 1


def test_command_line_writes_one_picture(tmp_path, capsys):
    assert main(["--category", "safe", "--out", str(tmp_path / "new")]) == 0
    (path,) = (tmp_path / "new").iterdir()
    assert capsys.readouterr().out.strip() == str(path)
    assert path.name == "safe-procedural.png"
    assert path.stat().st_size < 300_000
    assert Image.open(path).width == 1440


def test_command_line_reports_bad_input_in_one_line(tmp_path, capsys):
    assert main(["--category", "safe", "--root", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error: source 'procedural' reads no files")
    assert not (tmp_path / "out").exists()


def test_a_negative_seed_is_refused_by_its_option(capsys):
    with pytest.raises(SystemExit):
        main(["--category", "safe", "--seed", "-1"])
    assert "argument --seed: must be at least 0, not -1" in capsys.readouterr().err
