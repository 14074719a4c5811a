from dataclasses import fields

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import OBJECTS, result_of

from articulate_ssl.inference.export.arrays import FILE_NAME, ResultFolderError, load_scan_prediction, write
from articulate_ssl.inference.prediction import Prediction

FULL = dict(rival=synthetic.laptop(seed=3)[0], probability=0.87, unlike=0.25, upright=True)


def same(a, b) -> bool:
    if isinstance(a, Prediction):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    return np.array_equal(a, b) and type(a) is type(b)


def rewritten(folder, drop=(), **changes) -> None:
    """The file with other entries."""
    with np.load(folder / FILE_NAME) as old:
        entries = {name: old[name] for name in old.files if name not in drop} | changes
    np.savez(folder / FILE_NAME, **entries)


@pytest.mark.parametrize("make", OBJECTS)
@pytest.mark.parametrize("changes", [{}, FULL], ids=["plain", "full"])
def test_what_is_read_is_what_was_written(tmp_path, make, changes):
    result = result_of(make, **changes)
    assert write(result, tmp_path) == [tmp_path / "prediction.npz"]
    again = load_scan_prediction(tmp_path)
    for field in fields(result):
        assert same(getattr(result, field.name), getattr(again, field.name)), field.name


def test_no_checkpoint_stays_none(tmp_path):
    write(result_of(synthetic.laptop, checkpoint=None), tmp_path)
    assert load_scan_prediction(tmp_path).checkpoint is None


def test_the_same_prediction_gives_the_same_bytes(tmp_path):
    (file,) = write(result_of(synthetic.laptop, **FULL), tmp_path)
    first = file.read_bytes()
    write(result_of(synthetic.laptop, **FULL), tmp_path)
    assert file.read_bytes() == first


def refused(folder, *words: str) -> None:
    with pytest.raises(ResultFolderError) as refusal:
        load_scan_prediction(folder)
    assert all(word in str(refusal.value) for word in (str(folder), *words)), refusal.value


def test_a_folder_without_a_prediction_is_refused_with_the_remedy(tmp_path):
    refused(tmp_path, "no prediction.npz", "articulate-ssl predict")
    refused(tmp_path / "nowhere", "no prediction.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", b"no zip at all"])
def test_a_damaged_file_is_refused(tmp_path, content):
    (tmp_path / FILE_NAME).write_bytes(content)
    refused(tmp_path, "damaged", "predict the scan again")


def test_half_a_file_is_refused(tmp_path):
    (file,) = write(result_of(synthetic.laptop), tmp_path)
    file.write_bytes(file.read_bytes()[:-5000])
    refused(tmp_path, "damaged")


def test_a_file_that_is_damaged_within_is_refused(tmp_path):
    (file,) = write(result_of(synthetic.laptop), tmp_path)
    content = file.read_bytes()
    method = content.index(b"PK\x01\x02") + 10  # of compression, in the table of contents
    for place in (len(content) // 2, method):
        file.write_bytes(content[:place] + b"\x63" + content[place + 1 :])
        refused(tmp_path, "damaged")
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(file)
    refused(tmp_path, "damaged, or no file of ours")


def test_pickled_objects_are_refused(tmp_path):
    write(result_of(synthetic.laptop), tmp_path)
    rewritten(tmp_path, center=np.array([{}], dtype=object))
    refused(tmp_path, "pickle")


@pytest.mark.parametrize("name", ["cloud", "limits", "prediction.part_pose"])
def test_a_file_that_lacks_something_is_refused(tmp_path, name):
    write(result_of(synthetic.laptop), tmp_path)
    rewritten(tmp_path, drop=[name])
    refused(tmp_path, f"lacks {name}")


@pytest.mark.parametrize("version", [0, 99, [1, 2], "one"])
def test_another_format_is_refused(tmp_path, version):
    write(result_of(synthetic.laptop), tmp_path)
    rewritten(tmp_path, format=np.array(version))
    refused(tmp_path, "format")


def test_arrays_of_another_program_are_refused(tmp_path):
    np.savez(tmp_path / FILE_NAME, points=np.zeros((5, 3)))
    refused(tmp_path, "format")
