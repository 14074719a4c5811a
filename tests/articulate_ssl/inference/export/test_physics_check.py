import re
import sys

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
import trimesh
from joint_zoo import ZOO, snake
from scan_predictions import result_of

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.inference.export import mjcf, urdf
from articulate_ssl.inference.export.physics_check import (
    MIN_COVERED,
    OVERLAP_WORTH_A_NOTE,
    PhysicsCheckError,
    check,
)


def exported(folder, make, **changes):
    result = result_of(make, **changes)
    for write in (mjcf.write, urdf.write):
        write(result, folder)
    return folder


@pytest.mark.parametrize("make", ZOO)
def test_sound_objects_pass_in_both_formats(tmp_path, make):
    verdict = check(exported(tmp_path, make))
    assert verdict.passed, verdict.lines()
    assert [file.file for file in verdict.files] == ["object.xml", "object.urdf"]
    for file in verdict.files:
        assert len(file.joints) == len(result_of(make).limits)
        assert all(joint.covered > 0.99 for joint in file.joints)
    assert verdict.lines()[0].startswith("physics check passed")


def test_the_unit_of_the_scan_does_not_matter_where_it_is_unknown(tmp_path):
    millimetres, kilometres = (
        check(exported(tmp_path / f"{scale}", synthetic.laptop, center=np.zeros(3), scale=scale)).files[0]
        for scale in (300.0, 3e-4)
        if (tmp_path / f"{scale}").mkdir() is None
    )
    assert millimetres.passed and kilometres.passed
    assert millimetres.mass == pytest.approx(kilometres.mass, rel=1e-3)


def test_parts_overlap_alike_in_every_unit_so_the_scanned_state_is_scaled_joint_by_joint(tmp_path):
    shares = []
    for scale in (0.02, 1.0, 300.0):
        (tmp_path / f"{scale}").mkdir()
        shares.append(check(exported(tmp_path / f"{scale}", snake, scale=scale)).files[0].overlap)
    assert shares == pytest.approx([shares[0]] * 3, rel=1e-3) and shares[0] > 0.1


def test_a_stated_unit_sets_the_mass(tmp_path):
    folder = exported(tmp_path, synthetic.laptop, scale=300.0)
    verdict = check(folder, metres_per_unit=1e-3)
    volume = (0.8 * 0.55 * 0.04 + 0.8 * 0.55 * 0.03) * 0.3**3
    assert verdict.files[0].mass == pytest.approx(600 * volume, rel=0.15)  # hulls of samples are smaller
    assert verdict.passed
    assert "0.001 metres" in verdict.lines()[0]


def blocked(seed=0):
    """Two parts that slide into each other before their joints end."""
    boxes = [((0.8, 0.3, 0.02), (0, 0, 0)), ((0.1, 0.1, 0.1), (-0.2, 0, 0.1)), ((0.1, 0.1, 0.1), (0.2, 0, 0.1))]
    joints = [(PRISMATIC, 0, 1, (1.0, 0, 0), (-0.2, 0, 0.1)), (PRISMATIC, 0, 2, (1.0, 0, 0), (0.2, 0, 0.1))]
    return synthetic.chain_of_boxes(boxes, joints, [0.0, 0.0], seed=seed)


def test_a_joint_that_another_part_blocks_fails(tmp_path):
    verdict = check(exported(tmp_path, blocked, state_range=torch.tensor([[-0.1, 1.2], [0.0, 0.1]])))
    assert not verdict.passed
    for file in verdict.files:
        assert file.joints[0].covered < MIN_COVERED < file.joints[1].covered
    assert any(re.search(r"FAILED.*joint_0 covers", line) for line in verdict.lines())
    assert "FAILED" in verdict.lines()[0]


def test_a_file_that_mujoco_refuses_fails_with_its_reason(tmp_path):
    folder = exported(tmp_path, synthetic.laptop)
    text = (folder / "object.xml").read_text()
    (folder / "object.xml").write_text(re.sub(r'mass="[^"]*"', 'mass="-1"', text))
    verdict = check(folder)
    refused, sound = verdict.files
    assert refused.problem and "mass" in refused.problem and not refused.passed
    assert sound.passed and not verdict.passed
    assert any("does not load" in line for line in verdict.lines())


def test_what_never_comes_to_rest_fails(tmp_path):
    """A motor that turns the arm without end, as a stand-in for contacts that feed energy."""
    folder = exported(tmp_path, synthetic.laptop)
    text = (folder / "object.xml").read_text().replace('limited="true"', 'limited="false"')
    motor = '<actuator><general joint="joint_0" gaintype="fixed" biastype="affine" biasprm="20 0 0"/></actuator>'
    (folder / "object.xml").write_text(text.replace("</mujoco>", motor + "</mujoco>"))
    restless = check(folder).files[0]
    assert restless.finite and not restless.rests and not restless.passed
    assert any("still moves after 20 s" in line for line in restless.lines())


def folded(seed=0):
    """A lid that is half sunk into its base."""
    boxes = [((0.8, 0.55, 0.1), (0, 0, 0)), ((0.8, 0.55, 0.1), (0, 0, 0.05))]
    return synthetic.chain_of_boxes(boxes, [(REVOLUTE, 0, 1, (-1.0, 0, 0), (0, 0.275, 0.02))], [0.0], seed=seed)


def test_parts_that_lie_in_each_other_get_a_note_and_still_pass(tmp_path):
    verdict = check(exported(tmp_path, folded))
    assert verdict.passed
    assert all(file.overlap > OVERLAP_WORTH_A_NOTE for file in verdict.files)
    assert any(re.search("note .*share", line) for line in verdict.lines())


def test_the_files_stay_as_they_are(tmp_path):
    folder = exported(tmp_path, snake)
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    check(folder)
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


def test_meshes_of_an_earlier_and_larger_object_do_not_count(tmp_path):
    alone = check(exported(tmp_path, synthetic.laptop), metres_per_unit=None)
    trimesh.creation.box((40, 30, 50)).export(tmp_path / "meshes" / "part_2.stl")
    assert check(str(tmp_path)) == alone


def test_only_the_models_that_are_named_are_tried(tmp_path):
    folder = exported(tmp_path, synthetic.laptop)
    assert [file.file for file in check(folder, names=["prediction.json", "object.urdf"]).files] == ["object.urdf"]
    with pytest.raises(PhysicsCheckError, match="export urdf or mjcf there first"):
        check(folder, names=["prediction.json"])


@pytest.mark.parametrize("content", ["", "<mujoco>", "no XML"])
def test_a_model_that_is_no_xml_fails_with_its_reason(tmp_path, content):
    folder = exported(tmp_path, synthetic.laptop)
    (folder / "object.xml").write_text(content)
    refused, sound = check(folder).files
    assert refused.problem and sound.passed


def test_without_mujoco_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(PhysicsCheckError, match=r"pip install 'articulate-ssl\[mujoco\]'"):
        check(tmp_path)


def test_a_folder_without_models_is_named(tmp_path):
    with pytest.raises(PhysicsCheckError, match=f"{tmp_path}.*export urdf or mjcf"):
        check(tmp_path)


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf")])
def test_a_unit_that_is_no_length_is_refused(tmp_path, unit):
    with pytest.raises(PhysicsCheckError, match="positive"):
        check(exported(tmp_path, synthetic.laptop), metres_per_unit=unit)
