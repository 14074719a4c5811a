"""Shape2Motion's pickled map from triangles to parts, read without running what a pickle can run.

The file is `np.save` of a Python dict, which numpy reads only with `allow_pickle=True`. The unpickler here knows a dict
of Python or numpy integers and refuses everything else; numpy's own classes are replaced by inert ones.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np


def load_face_map(file: Path) -> dict[int, int]:
    """Part index by triangle index.

    Raises:
        ValueError: naming the file, if it is missing, damaged, or holds anything but a dict of integers to integers.
    """
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, _, dtype = read_header[version](stream)
            if shape != () or dtype != np.dtype(object):
                raise ValueError(f"array of shape {shape} and type {dtype}")
            content = _FaceMapUnpickler(stream, encoding="latin1").load().item
    except OSError as error:
        raise ValueError(f"{file}: face map is missing or unreadable ({error.strerror})") from error
    except Exception as error:  # a damaged pickle raises whatever its bytes run into
        raise ValueError(f"{file}: not a pickled face map of integers ({type(error).__name__}: {error})") from error
    if type(content) is not dict or {type(i) for pair in content.items() for i in pair} - {int}:
        raise ValueError(f"{file}: not a pickled face map, its content is no dict of integers to integers")
    return content


class _FaceMapUnpickler(pickle.Unpickler):
    """Resolves only the names that numpy's pickles of a 0-d object array and of integers use, to stand-ins."""

    def find_class(self, module: str, name: str):
        if (module, name) in _STAND_INS:
            return _STAND_INS[module, name]
        raise pickle.UnpicklingError(f"refers to {module}.{name}")


class _Array:
    """Stands in for the 0-d object array: keeps its one element."""

    def __init__(self, *_: object) -> None:
        self.item: object = None

    def __setstate__(self, state: tuple) -> None:
        (self.item,) = state[-1]


class _IntegerType:
    """Stands in for the dtype of a numpy integer."""

    def __init__(self, code: str, *_: object) -> None:
        self.signed, self.size, self.byte_order = code[0] == "i", int(code[1:]), "<"
        if code[0] not in "iu" or self.size > 8:
            raise pickle.UnpicklingError(f"refers to numpy type {code!r}")

    def __setstate__(self, state: tuple) -> None:
        self.byte_order = state[1]


class _ObjectType:
    """Stands in for the dtype of the array."""

    def __setstate__(self, state: tuple) -> None:
        """There is nothing to keep."""


def _dtype(code: str, *_: object) -> _IntegerType | _ObjectType:
    return _ObjectType() if code.startswith("O") else _IntegerType(code)


def _scalar(dtype: _IntegerType, data: bytes | str) -> int:
    raw = data.encode("latin1") if isinstance(data, str) else data
    if len(raw) != dtype.size:
        raise pickle.UnpicklingError(f"an integer of {len(raw)} bytes")
    return int.from_bytes(raw, "big" if dtype.byte_order == ">" else "little", signed=dtype.signed)


_STAND_INS = {("numpy", "ndarray"): _Array, ("numpy", "dtype"): _dtype}
for _module in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _STAND_INS |= {(_module, "_reconstruct"): _Array, (_module, "scalar"): _scalar}
