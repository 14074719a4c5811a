import os
import pickle

import numpy as np
import pytest

from render.sources.face_map import load_face_map


def save(file, content, **kwargs):
    np.save(file, np.array(content, dtype=object), allow_pickle=True, **kwargs)
    return file


@pytest.mark.parametrize("integer", [int, np.int64, np.int32, np.uint8, np.dtype(">i4").type])
def test_reads_dicts_of_integers(tmp_path, integer):
    face_map = {integer(face): integer(face % 3) for face in range(100)}
    loaded = load_face_map(save(tmp_path / "map.npy", face_map))
    assert loaded == face_map
    assert {type(i) for pair in loaded.items() for i in pair} == {int}


def python2_strings(pickled: bytes) -> bytes:
    """The pickle as Python 2 wrote it: protocol 2, and strings (U) where Python 3 writes bytes (C)."""
    pickled = pickled.replace(b"\x80\x03", b"\x80\x02", 1).replace(b"C\x01b", b"U\x01b", 1)
    return pickled.replace(b"C\x02\xfb\xff", b"U\x02\xfb\xff").replace(b"C\x08\0", b"U\x08\0")


@pytest.mark.parametrize("python2", [False, True])
def test_reads_what_older_numpy_wrote_and_negative_numbers(tmp_path, python2):
    data = pickle.dumps(np.array({0: np.int16(-5), 1: np.int64(2**40)}, dtype=object), protocol=3)
    data = data.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    data = python2_strings(data) if python2 else data
    assert (b"C\x02" not in data) == python2
    with open(tmp_path / "map.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(data)
    assert load_face_map(tmp_path / "map.npy") == {0: -5, 1: 2**40}


class Attack:
    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return os.system, (f"touch {self.file}",)


def test_pickled_code_does_not_run(tmp_path):
    trace = tmp_path / "trace"
    save(tmp_path / "map.npy", {0: Attack(trace)})
    with pytest.raises(ValueError, match=r"map\.npy: not a pickled face map .*refers to (posix|nt)\.system"):
        load_face_map(tmp_path / "map.npy")
    assert not trace.exists()


@pytest.mark.parametrize(
    "content",
    [{0: 1.5}, {0: "1"}, {"0": 1}, {0: None}, {0: True}, {0: [1]}, {0: np.float64(1)}, [0, 1], 3, {0: {1: 2}}],
)
def test_anything_but_a_dict_of_integers_is_refused(tmp_path, content):
    array = np.empty((), dtype=object)
    array[()] = content
    np.save(tmp_path / "map.npy", array, allow_pickle=True)
    with pytest.raises(ValueError, match=r"map\.npy: not a pickled face map"):
        load_face_map(tmp_path / "map.npy")


def test_missing_damaged_and_plain_arrays_are_refused(tmp_path):
    file = tmp_path / "map.npy"
    with pytest.raises(ValueError, match=r"map\.npy: face map is missing"):
        load_face_map(file)
    save(file, {0: 1})
    data = file.read_bytes()
    for damaged in (b"", data[:20], data[:-8], b"\x93NUMPY\x09\x00" + data[8:], data[:128] + b"garbage"):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"map\.npy: not a pickled face map"):
            load_face_map(file)
    np.save(file, np.arange(3))
    with pytest.raises(ValueError, match=r"map\.npy: not a pickled face map .*array of shape \(3,\)"):
        load_face_map(file)
