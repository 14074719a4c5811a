import pytest

from render.sources.dataset_folder import find_instances, read_json


def make(root, *folders):
    for folder in folders:
        (root / folder).mkdir(parents=True)
        (root / folder / "marker").write_text("")


def test_the_categorys_folder_is_found_below_prefixes(tmp_path):
    make(tmp_path, "articulated/Safe/002", "articulated/Safe/001", "articulated/Safe/.git/x", "articulated/Laptop/001")
    for root in (tmp_path, tmp_path / "articulated", tmp_path / "articulated/Safe"):
        found = find_instances(root, "marker", ["safe", "Safe"], (".", "articulated"))
        assert list(found) == ["001", "002"]
    assert list(find_instances(tmp_path, "marker")) == [
        "articulated/Laptop/001",
        "articulated/Safe/001",
        "articulated/Safe/002",
    ]
    assert list(find_instances(tmp_path / "articulated/Safe/002", "marker", ["Safe"])) == ["002"]


def test_a_link_that_leads_back_is_no_endless_search(tmp_path):
    make(tmp_path, "a/001")
    (tmp_path / "a/loop").symlink_to(tmp_path)
    assert "a/001" in find_instances(tmp_path, "marker")


def test_errors_name_the_place(tmp_path):
    with pytest.raises(ValueError, match="no instance found, no folder in it holds a marker"):
        find_instances(tmp_path, "marker")
    with pytest.raises(ValueError, match=r"gone: not a folder; --root must name"):
        find_instances(tmp_path / "gone", "marker")
    with pytest.raises(ValueError, match="no root given"):
        find_instances(None, "marker")
    for content in (b"{", b"\xff\xfe", b"[" * 100000):
        (tmp_path / "x.json").write_bytes(content)
        with pytest.raises(ValueError, match=r"x\.json: not valid JSON"):
            read_json(tmp_path / "x.json")
