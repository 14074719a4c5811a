import pytest
import synthetic_predictions as synthetic
from scan_predictions import OBJECTS, result_of

from articulate_ssl.inference.export import formats, picture, prediction_json, rigid_links
from articulate_ssl.inference.export.folder import EXPORTERS, EXPORTERS_BY_NAME, exporters_named, write_prediction
from articulate_ssl.inference.export.formats import FORMATS, ON_REQUEST, ExportError


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch):
    """Pictures have tests of their own, and take a second each."""
    monkeypatch.setattr(picture, "draw_prediction", lambda *arguments: arguments[-1].touch())


@pytest.mark.parametrize("make", OBJECTS)
def test_the_folder_holds_what_was_promised_and_no_more(tmp_path, make):
    files = write_prediction(result_of(make), tmp_path)
    meshes = {f"meshes/part_{k}.stl" for k in range(make()[0].num_parts)}
    clouds = {"parts.ply", "reconstruction.ply"}
    models = {"object.urdf", "object.xml", "object.glb", "object.usda"}
    expected = {"prediction.json", "prediction.npz", "picture.png"} | clouds | models | meshes
    assert len(files) == len(expected)
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

    monkeypatch.setattr(rigid_links, "canonical_object", fail)
    monkeypatch.setattr(prediction_json, "describe", fail)
    with pytest.raises(RuntimeError):
        write_prediction(result_of(synthetic.laptop), tmp_path)
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before


def test_exporters_are_found_by_name_and_the_json_stays_last():
    assert tuple(EXPORTERS_BY_NAME) == FORMATS and FORMATS[-1] == "json"
    found = exporters_named(["json", "glb", "urdf", "glb"])
    assert found == tuple(EXPORTERS_BY_NAME[name] for name in ("urdf", "glb", "json"))
    usual = [name for name in EXPORTERS_BY_NAME if name not in ON_REQUEST]
    assert exporters_named(None) == EXPORTERS == exporters_named(usual)
    assert exporters_named([]) == ()


def test_the_moving_picture_is_written_only_where_it_is_asked_for():
    gif = EXPORTERS_BY_NAME["gif"]
    assert gif not in exporters_named(None)
    assert exporters_named(["gif"]) == (gif,)


def test_a_format_without_mesh_files_leaves_no_empty_folder(tmp_path):
    write_prediction(result_of(synthetic.laptop), tmp_path / "new", exporters_named(["json"]))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["prediction.json"]


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ExportError, match=r"no export is called fbx; there are clouds, urdf, .*json"):
        exporters_named(["urdf", "fbx"])


def test_a_format_whose_package_is_missing_is_left_out_and_refused_where_asked_for(monkeypatch):
    monkeypatch.setattr(formats, "find_spec", lambda package: None)
    assert EXPORTERS_BY_NAME["usd"] not in exporters_named(None)
    assert len(exporters_named(None)) == len(EXPORTERS) - 1
    with pytest.raises(ExportError, match=r"usd needs .*pxr.* pip install 'articulate-ssl\[usd\]'"):
        exporters_named(["json", "usd"])
