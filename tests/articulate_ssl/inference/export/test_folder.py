import pytest
import synthetic_predictions as synthetic
from scan_predictions import OBJECTS, result_of

from articulate_ssl.inference.export import picture, prediction_json, urdf
from articulate_ssl.inference.export.folder import EXPORTERS, write_prediction


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch):
    """Pictures have tests of their own, and take a second each."""
    monkeypatch.setattr(picture, "draw_prediction", lambda *arguments: arguments[-1].touch())


@pytest.mark.parametrize("make", OBJECTS)
def test_the_folder_holds_what_was_promised_and_no_more(tmp_path, make):
    files = write_prediction(result_of(make), tmp_path)
    meshes = {f"meshes/part_{k}.stl" for k in range(make()[0].num_parts)}
    expected = {"prediction.json", "parts.ply", "reconstruction.ply", "object.urdf", "picture.png"} | meshes
    assert {str(f.relative_to(tmp_path)) for f in files} == expected
    assert {str(f.relative_to(tmp_path)) for f in tmp_path.rglob("*") if f.is_file()} == expected


def test_the_json_comes_last(tmp_path):
    assert write_prediction(result_of(synthetic.laptop), tmp_path)[-1] == tmp_path / "prediction.json"


def test_one_more_exporter_is_written_with_the_rest(tmp_path):
    def write_name(result, folder):
        file = folder / "name.txt"
        file.write_text(f"{result.category}, {result.prediction.num_parts} parts")
        return [file]

    usual = write_prediction(result_of(synthetic.laptop), tmp_path / "usual")
    files = write_prediction(result_of(synthetic.laptop), tmp_path / "more", [write_name, *EXPORTERS])
    assert files[0].read_text() == "thing, 2 parts"
    assert [f.relative_to(tmp_path / "more") for f in files[1:]] == [f.relative_to(tmp_path / "usual") for f in usual]


def test_where_a_folder_cannot_be_made_nothing_is_written(tmp_path):
    (tmp_path / "meshes").write_text("mine")
    with pytest.raises(FileExistsError):
        write_prediction(result_of(synthetic.laptop), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["meshes"]


def test_a_failure_half_way_leaves_the_earlier_results(tmp_path, monkeypatch):
    write_prediction(result_of(synthetic.laptop), tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}

    def fail(*_):
        raise RuntimeError("disk full")

    monkeypatch.setattr(urdf, "part_mesh", fail)
    monkeypatch.setattr(prediction_json, "describe", fail)
    with pytest.raises(RuntimeError):
        write_prediction(result_of(synthetic.laptop), tmp_path)
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before
