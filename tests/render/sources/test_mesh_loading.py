import numpy as np
import pytest
import trimesh

from render.sources.mesh_loading import MESH_TYPES, concatenate, load_mesh, parse_xml, resolve_inside, transformed

BOX = trimesh.creation.box(bounds=[[0, 0, 0], [1, 2, 3]])
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize("file_type", MESH_TYPES)
def test_every_type_gives_the_same_surface(tmp_path, file_type):
    BOX.export(tmp_path / f"box.{file_type}")
    mesh = load_mesh(tmp_path / f"box.{file_type}")
    np.testing.assert_allclose(mesh.bounds, BOX.bounds, atol=1e-6)
    assert mesh.volume == pytest.approx(6)
    assert len(mesh.faces) == 12


def test_pieces_of_a_scene_are_placed_and_joined(tmp_path):
    scene = trimesh.Scene([BOX])
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix([0, 0, 10]))
    scene.export(tmp_path / "two.glb")
    np.testing.assert_allclose(load_mesh(tmp_path / "two.glb").bounds, [[0, 0, 0], [1, 2, 13]])


def test_collada_is_scaled_to_metres(tmp_path):
    file = tmp_path / "box.dae"
    BOX.export(file)
    text = file.read_text()
    assert 'meter="1"' in text or "<unit" not in text
    unit = '<unit name="centimeter" meter="0.01"/>'
    text = (
        text.replace("</asset>", f"{unit}</asset>")
        if "<unit" not in text
        else text.replace('meter="1"', 'meter="0.01"')
    )
    file.write_text(text)
    np.testing.assert_allclose(load_mesh(file).bounds, BOX.bounds / 100, atol=1e-9)


def test_obj_keeps_face_order_through_materials_groups_and_polygons(tmp_path):
    file = tmp_path / "x.obj"
    file.write_text(
        TRIANGLE + "vt 0 0\nvn 0 0 1\nmtllib ../../secret.mtl\nusemtl a\nf 1/1/1 2/1/1 3/1/1\nv 1 1 0\nusemtl b\ng k\n"
        "f 1//1 2//1 4//1 3//1\nusemtl a\nf -1 -2 \\\n -3\r\nv 9 9 9 0.5 0.5 0.5\nl 1 2\n"
    )
    mesh = load_mesh(file)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3], [0, 3, 2], [3, 2, 1]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "mesh is empty"),
        (TRIANGLE, "mesh is empty"),
        (TRIANGLE.replace("v 1", "v nan") + "f 1 2 3\n", "NaN or infinite vertices"),
        (TRIANGLE.replace("v 1", "v inf") + "f 1 2 3\n", "NaN or infinite vertices"),
        (TRIANGLE + "f 1 2 4\n", "not a readable obj mesh"),
        (TRIANGLE + "f 0 1 2\n", "bad face 'f 0 1 2'"),
        (TRIANGLE + "f 1 2\n", "bad face 'f 1 2'"),
        (TRIANGLE + "f 1 2 x\n", "not a readable obj mesh"),
        (TRIANGLE + "v 1 a 2\nf 1 2 3\n", "not a readable obj mesh"),
        (TRIANGLE + "f -1 -2 -4\n", "bad face 'f -1 -2 -4'"),
    ],
)
def test_bad_obj_is_one_error_that_names_the_file(tmp_path, content, message):
    (tmp_path / "bad.obj").write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        load_mesh(tmp_path / "bad.obj")
    assert str(tmp_path / "bad.obj") in str(error.value)


@pytest.mark.parametrize("file_type", MESH_TYPES)
def test_damaged_files_are_refused(tmp_path, file_type):
    file = tmp_path / f"box.{file_type}"
    BOX.export(file)
    data = file.read_bytes()
    for damaged in (b"", b"\x00\x01\x02garbage" * 20, data[: len(data) // 3]):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"box\.{file_type}: "):
            load_mesh(file)


def test_missing_and_unknown_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.obj: mesh is missing"):
        load_mesh(tmp_path / "gone.obj")
    with pytest.raises(ValueError, match=r"'\.zip' is not supported; convert it to obj, stl"):
        load_mesh(tmp_path / "mesh.zip")


BOMB = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize("doctype", [BOMB, '<!DOCTYPE x SYSTEM "file:///etc/passwd">', "<!DOCTYPE x>"])
def test_entity_bombs_are_refused_in_collada_too(tmp_path, doctype):
    with pytest.raises(ValueError, match=r"x\.urdf: declares a DTD or entities"):
        parse_xml(f"{doctype}<x>1</x>".encode(), tmp_path / "x.urdf")
    (tmp_path / "x.dae").write_text(f"{doctype}<COLLADA>&b;</COLLADA>")
    with pytest.raises(ValueError, match=r"x\.dae: declares a DTD or entities"):
        load_mesh(tmp_path / "x.dae")


def test_paths_cannot_leave_the_root(tmp_path):
    root, file = tmp_path / "root", tmp_path / "root/robot/x.urdf"
    file.parent.mkdir(parents=True)
    (tmp_path / "outside.obj").write_text("")
    (root / "link.obj").symlink_to(tmp_path / "outside.obj")
    assert resolve_inside("../meshes/a.obj", file.parent, root, file) == root / "meshes/a.obj"
    for reference in ("../../outside.obj", "/etc/passwd", "../link.obj", "a/../../../outside.obj"):
        with pytest.raises(ValueError, match=r"x\.urdf: .*outside .*move the file into that folder"):
            resolve_inside(reference, file.parent, root, file)


def test_mirrored_surface_keeps_its_outside_outside():
    mirrored = transformed(BOX, np.diag([-1.0, 2, 2, 1]))
    assert mirrored.volume == pytest.approx(24)
    np.testing.assert_allclose(mirrored.bounds, [[-1, 0, 0], [0, 4, 6]])


def test_joining_nothing_is_an_empty_surface():
    assert concatenate([]).faces.shape == (0, 3)
    assert concatenate([concatenate([]), BOX, BOX]).faces.max() == 15
