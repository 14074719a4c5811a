"""The npz shard format: S clouds of one category in one file, with their labels or without any.

Symbols: S samples, P points of a cloud, K parts, J joints. Everything is in normalised units,
`points = (metric points - center) / scale`; camera space is the space of `points`. Radians.

    points           camera space, farthest-point ordered (partial clouds: the first 2048): a prefix is an even sample
    part_id          part of every point
    part_pose        canonical object frame / scale -> camera space
    part_center      rest-state bounding-box centre of each part, canonical object frame / scale
    joint_axis       unit direction, camera space
    joint_pivot      a point on the joint line, camera space
    joint_state      the joint's own coordinate: radians, or length / scale
    joint_parent     part nearer to the base
    joint_child      part that the joint moves
    joint_type       0 revolute, 1 prismatic
    instance         index into `Manifest.instances[split]`
    object_rotation  canonical object frame -> camera space
    center, scale    of the normalisation, camera space, in the units of the source

A set of scans that nobody labelled has shards of `UNLABELLED_ARRAYS` alone; there an instance is an object that was
scanned, possibly several times.

A shard is an uncompressed zip of npy files with fixed time stamps, so equal arrays give equal bytes. Every array starts
at a multiple of 64 bytes, so readers map it into memory instead of reading it.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from datamodules.atomic import atomic_write

ALIGNMENT = 64
LOCAL_HEADER_BYTES = 30
PADDING_FIELD_ID = 0xD935  # the "extra field" id that Android's zipalign uses for padding


@dataclass(frozen=True)
class ArraySpec:
    """Dtype and shape of one array; letters in `shape` stand for sizes that must agree over all arrays of a shard."""

    dtype: str
    shape: tuple[str | int, ...]


SHARD_ARRAYS: dict[str, ArraySpec] = {
    "points": ArraySpec("float32", ("S", "P", 3)),
    "part_id": ArraySpec("uint8", ("S", "P")),
    "part_pose": ArraySpec("float32", ("S", "K", 4, 4)),
    "part_center": ArraySpec("float32", ("S", "K", 3)),
    "joint_axis": ArraySpec("float32", ("S", "J", 3)),
    "joint_pivot": ArraySpec("float32", ("S", "J", 3)),
    "joint_state": ArraySpec("float32", ("S", "J")),
    "joint_parent": ArraySpec("int8", ("S", "J")),
    "joint_child": ArraySpec("int8", ("S", "J")),
    "joint_type": ArraySpec("uint8", ("S", "J")),
    "instance": ArraySpec("int32", ("S",)),
    "object_rotation": ArraySpec("float32", ("S", 3, 3)),
    "center": ArraySpec("float32", ("S", 3)),
    "scale": ArraySpec("float32", ("S",)),
}

UNLABELLED_ARRAYS = ("points", "instance", "center", "scale")

# What zipfile and numpy raise on damaged headers; RuntimeError covers unsupported and encrypted members.
STRUCTURE_ERRORS = (
    EOFError,
    KeyError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)

REPAIR = "Delete it and repeat the `make data` command that made the set: it makes only what is missing."


class ShardError(ValueError):
    """A shard is missing, damaged or not in the shard format; the message names the file and the remedy."""


def sha256_of(path: str | os.PathLike) -> str:
    """Hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_shard(path: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> str:
    """Write one shard atomically and return its SHA-256.

    Args:
        path: Final name; its folder must exist.
        arrays: Exactly the arrays of `SHARD_ARRAYS`, or of `UNLABELLED_ARRAYS`.

    Raises:
        ShardError: if an array is missing, unknown, not finite, or of another dtype or shape than specified.
        OSError: if the file cannot be written; nothing is left under `path`.
    """
    problem = schema_problem({name: (array.dtype, array.shape) for name, array in arrays.items()})
    if problem is None:
        not_finite = [n for n, a in arrays.items() if a.dtype.kind == "f" and not np.isfinite(a).all()]
        problem = f"array {not_finite[0]!r} has NaN or infinite values" if not_finite else None
    if problem is not None:
        raise ShardError(f"{path}: refusing to write the shard: {problem}")
    with atomic_write(path) as file:
        _write_npz(file, arrays)
        file.flush()
        return sha256_of(file.name)


def read_shard(path: str | os.PathLike, expected_sha256: str | None = None) -> dict[str, np.ndarray]:
    """The arrays of a shard, read-only and mapped into memory: nothing is read before it is used.

    Args:
        path: Shard file.
        expected_sha256: Checked first if given. Without it, damage inside the arrays goes unnoticed.

    Raises:
        ShardError: if the file is missing, damaged (by checksum or structure), or not in the shard format.
    """
    path = Path(path)
    if not path.is_file():
        raise ShardError(f"{path}: shard is missing. Repeat the `make data` command that made the set to complete it.")
    if expected_sha256 is not None and (actual := sha256_of(path)) != expected_sha256:
        raise ShardError(
            f"{path}: shard is damaged: its SHA-256 is {actual[:12]}…, not {expected_sha256[:12]}…. {REPAIR}"
        )
    with open(path, "rb") as file:
        try:
            arrays = _map_npz(file)
        except STRUCTURE_ERRORS as error:
            raise ShardError(f"{path}: shard is damaged or truncated ({error}). {REPAIR}") from error
    problem = schema_problem({name: (array.dtype, array.shape) for name, array in arrays.items()})
    if problem is not None:
        raise ShardError(f"{path}: not a shard of this format: {problem}. {REPAIR}")
    return arrays


def schema_problem(arrays: Mapping[str, tuple[np.dtype, tuple[int, ...]]]) -> str | None:
    """What is wrong with the dtypes and shapes of a shard's arrays, or None."""
    specified = specified_arrays(arrays)
    if missing := [name for name in specified if name not in arrays]:
        return f"array {missing[0]!r} is missing"
    if unknown := [name for name in arrays if name not in SHARD_ARRAYS]:
        return f"array {unknown[0]!r} is unknown"
    sizes: dict[str, int] = {}
    for name, spec in specified.items():
        dtype, shape = arrays[name]
        if dtype != np.dtype(spec.dtype):
            return f"array {name!r} has dtype {dtype}, expected {spec.dtype}"
        expected = [sizes.get(size, size) if isinstance(size, str) else size for size in spec.shape]
        if len(shape) != len(expected) or any(
            isinstance(e, int) and e != n for e, n in zip(expected, shape, strict=True)
        ):
            return f"array {name!r} has shape {list(shape)}, expected [{', '.join(map(str, expected))}]"
        sizes.update((size, n) for size, n in zip(spec.shape, shape, strict=True) if isinstance(size, str))
    if empty := [size for size in "SPK" if sizes.get(size) == 0]:
        return f"size {empty[0]} is zero"
    return None


def specified_arrays(found: Iterable[str]) -> dict[str, ArraySpec]:
    """The arrays that a shard must have, in order: all if there is any label among those found in it."""
    labelled = set(found) & set(SHARD_ARRAYS) - set(UNLABELLED_ARRAYS)
    return {name: spec for name, spec in SHARD_ARRAYS.items() if labelled or name in UNLABELLED_ARRAYS}


def _write_npz(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    """An uncompressed npz in the order of `SHARD_ARRAYS`, its bytes a function of the arrays alone."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name in specified_arrays(arrays):
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(arrays[name]), version=(1, 0), allow_pickle=False)
            member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            member.create_system = 3
            member.external_attr = 0o644 << 16
            # The npy header is itself a multiple of 64 bytes long.
            start = file.tell() + LOCAL_HEADER_BYTES + len(member.filename) + 4
            padding = -start % ALIGNMENT
            member.extra = struct.pack("<HH", PADDING_FIELD_ID, padding) + bytes(padding)
            archive.writestr(member, content.getbuffer())


def _map_npz(file: BinaryIO) -> dict[str, np.ndarray]:
    """Every array of an npz, mapped into memory where it is stored uncompressed."""
    arrays = {}
    mapped = np.memmap(file, dtype=np.uint8, mode="r")
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            with archive.open(member) as content:
                version = np.lib.format.read_magic(content)
                if version != (1, 0):
                    raise ValueError(f"array {name!r} has npy version {version}, expected (1, 0)")
                shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(content)
                header_bytes = content.tell()
            if dtype.hasobject or fortran_order:
                raise ValueError(f"array {name!r} holds objects or is in Fortran order")
            if member.compress_type != zipfile.ZIP_STORED:
                with archive.open(member) as content:
                    arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
                continue
            # Only the member's own header, not the directory, says how long its name and extra fields are.
            file.seek(member.header_offset)
            name_bytes, extra_bytes = struct.unpack("<26xHH", file.read(LOCAL_HEADER_BYTES))
            start = member.header_offset + LOCAL_HEADER_BYTES + name_bytes + extra_bytes + header_bytes
            arrays[name] = np.ndarray(shape, dtype, buffer=mapped, offset=start)
    return arrays
