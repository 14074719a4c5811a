"""Category specifications: the categories of design section 5 and one more, and what they demand of an instance."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from objects import box_laptop

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.category import category_names, load_category, made_category, parse_category

# parts, joints, train and test instances of design.md section 5
CATEGORIES = {
    "oven": (2, 1, 28, 4),
    "washing_machine": (2, 1, 36, 5),
    "eyeglasses": (3, 2, 37, 5),
    "laptop": (2, 1, 73, 9),
    "safe": (2, 1, 26, 4),
    "laptop_real": (2, 1, 44, 6),
    "drawer": (4, 3, 24, 6),
    "desk_lamp": (4, 3, 24, 6),  # not of the paper: a serial chain
}


@pytest.mark.parametrize("name", CATEGORIES)
def test_counts_are_those_of_the_design(name):
    spec = load_category(name)
    assert (len(spec.parts), len(spec.joints), spec.train_instances, spec.test_instances) == CATEGORIES[name]
    assert set(CATEGORIES) <= set(category_names())


def test_unknown_category_names_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown category 'toaster'.*laptop"):
        load_category("toaster")


def test_a_variant_changes_the_design_and_nothing_else():
    safe, variant = load_category("safe"), load_category("safe", "both_sides")
    assert (safe.design_options, variant.design_options) == ({}, {"right_hinged": 0.5})
    assert replace(variant, variant=None) == safe
    with pytest.raises(ValueError, match=r"'safe' has no variant 'left'; it has both_sides"):
        load_category("safe", "left")
    with pytest.raises(ValueError, match=r"'oven' has no variant 'both_sides'; it has none"):
        load_category("oven", "both_sides")


def test_hinges_may_be_asked_for_in_other_states_and_nothing_else_changes():
    oven = load_category("oven")
    closed = oven.with_hinges_within(0.0, pi / 4)
    assert (closed.joints[0].lower, closed.joints[0].upper, closed.joints[0].rest) == (0.0, pi / 4, 0.0)
    assert replace(closed, joints=oven.joints) == oven
    with pytest.raises(ValueError, match="the smaller one first, not 45 and 45 degrees"):
        oven.with_hinges_within(pi / 4, pi / 4)
    for name in ("drawer", "articulated"):
        with pytest.raises(ValueError, match=f"'{name}' has no hinges of its own"):
            load_category(name).with_hinges_within(0, 1)


def test_laptop_range_is_within_the_limits_of_the_hinge():
    spec, laptop = load_category("laptop"), box_laptop()
    np.testing.assert_allclose(np.rad2deg(spec.sampled_ranges(laptop)), [[9, 99]])
    stiff = replace(laptop, joints=(replace(laptop.joints[0], upper=pi / 4),))
    np.testing.assert_allclose(np.rad2deg(spec.sampled_ranges(stiff)), [[9, 45]])
    welded = replace(laptop, joints=(replace(laptop.joints[0], upper=0.1),))
    with pytest.raises(ValueError, match=r"'box'.*'hinge'.*exclude the category's range"):
        spec.sampled_ranges(welded)


def test_prismatic_range_is_a_share_of_the_travel():
    joint = load_category("drawer").joints[0]
    slide = replace(box_laptop().joints[0], type=1, lower=0.2, upper=0.6)
    assert joint.coordinate(0.5, slide) == pytest.approx(0.4)


def test_to_rest_moves_meshes_to_the_rest_state_of_the_category():
    closed = box_laptop()
    rest = load_category("laptop").to_rest(closed)
    assert rest.joints[0].rest == pytest.approx(pi / 2)
    base, lid = (mesh.bounds for mesh in rest.meshes)
    np.testing.assert_allclose(base, closed.meshes[0].bounds)
    # The lid, 0.02 thick and 0.2 deep, stands upright behind the base.
    np.testing.assert_allclose(lid[1] - lid[0], [0.3, 0.2, 0.02], atol=1e-12)


def test_to_rest_refuses_objects_of_another_category():
    with pytest.raises(ValueError, match=r"'box' has parts.*the category has parts"):
        load_category("oven").to_rest(box_laptop())


def test_a_users_file_needs_parts_and_joint_types_only(tmp_path):
    (tmp_path / "mybox.yaml").write_text("parts: [box, lid, tray]\njoints: [{type: revolute}, {type: prismatic}]\n")
    spec = load_category(str(tmp_path / "mybox.yaml"))
    assert (spec.name, spec.parts, spec.recognition) == ("mybox", ("box", "lid", "tray"), None)
    lid, tray = spec.joints
    assert (lid.type, lid.parent, lid.child, lid.rest) == (REVOLUTE, 0, 1, 0)
    assert (lid.lower, lid.upper) == (0, pytest.approx(pi / 2))
    assert (tray.type, tray.parent, tray.child, tray.lower, tray.upper) == (PRISMATIC, 0, 2, 0, 1)


def test_a_category_made_of_numbers_is_such_a_file():
    spec = parse_category("thing", made_category(4, "prismatic"))
    assert len(spec.parts) == 4
    assert [(joint.type, joint.parent, joint.child) for joint in spec.joints] == [(PRISMATIC, 0, k) for k in (1, 2, 3)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("parts: [box, lid]", "its file lacks joints"),
        ("- a", "its file must be a mapping of joints, parts"),
        ("a: [", "its file is not YAML"),
        ("parts: [box]\njoints: []", "has 1 parts and 0 joints"),
        ("parts: [box, lid]\njoints: []", "has 2 parts and 0 joints"),
        ("parts: [box, box]\njoints: [{type: revolute}]", "named twice"),
        ("parts: box\njoints: [{type: revolute}]", "parts must be a list"),
        ("parts: [box, lid]\njoints: [{name: hinge}]", "joint 0 lacks type"),
        ("parts: [box, lid]\njoints: [revolute]", "joint 0 must be a mapping of type"),
        ("parts: [box, lid]\njoints: [{type: ball}]", "joint 0 has type 'ball'; there are revolute and prismatic"),
        ("parts: [box, lid]\njoints: [{type: revolute, parent: bxo}]", "names the part 'bxo'; there are box, lid"),
        ("parts: [box, lid]\njoints: [{type: revolute, rang_deg: [0, 9]}]", "has unknown rang_deg; known are child,"),
        ("parts: [box, lid]\njoints: [{type: revolute, range_travel: [0, 1]}]", "it may have range_deg and rest_deg"),
        ("parts: [box, lid]\njoints: [{type: revolute, range_deg: [9, 0]}]", r"must be \[lowest, highest\]"),
        ("parts: [box, lid]\njoints: [{type: revolute, range_deg: [0, wide]}]", "must be a number, not 'wide'"),
        ("parts: [box, lid]\njoints: [{type: revolute}]\nveiw: {}", "has unknown veiw"),
        ("parts: [box, lid]\njoints: [{type: revolute}]\nview: {roll_deg: [0, 1]}", "view lacks azimuth_deg"),
    ],
)
def test_an_unsound_file_says_what_is_missing_or_wrong(tmp_path, text, message):
    (tmp_path / "mybox.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"category 'mybox': {message}|category 'mybox': .*{message}"):
        load_category(str(tmp_path / "mybox.yaml"))


def test_a_file_that_is_not_there_or_badly_named_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"box\.yaml: cannot be read \(No such file"):
        load_category(str(tmp_path / "box.yaml"))
    with pytest.raises(ValueError, match="use letters, digits"):
        load_category(str(tmp_path / "my box.yaml"))
