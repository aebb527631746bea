"""Mutations of files of arrays: `.npz` and safetensors, in their headers and their numbers."""

import io
import struct
import zipfile
from collections.abc import Sequence

import numpy as np

from tests.campaigns.numbers import mutate_json, pick

WRONG = (np.nan, np.inf, -np.inf, 1e308, -1e39, 1e15, 0.0, -1.0, 255.0, 32_767.0, 2.0**31, 2.0**53)
"""Numbers that are written into arrays."""

HEADERS: Sequence[bytes] = (
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (8.5,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (True, 2), }",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1L,), }",
    b"{'descr': '<f4', 'fortran_order': 1, 'shape': (), }",
    b"{'descr': '|V9999999', 'fortran_order': False, 'shape': (0,), }",
    b"{'descr': [('a', '<f4')], 'fortran_order': True, 'shape': (3, 2), }",
    b"{'descr': '<U99999999', 'fortran_order': False, 'shape': (), }",
    b"(" * 900,
    b"{'descr': ''' ",
    b"__import__('os').system('true')",
    b"[" * 200 + b"]" * 200,
    b"",
)
"""Headers that claim huge or odd shapes, objects, or that Python's parser stumbles over."""


def mutate_npz(rng: np.random.Generator, content: bytes) -> bytes:
    """Changes a member of an archive: its header, its numbers, its name, or whether it is there."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = pick(rng, sorted(members))
    kind = int(rng.integers(8))
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[pick(rng, ("../x.npy", "/etc/x.npy", "x.npy", "", name[:-4]))] = members.pop(name)
    elif kind == 2:
        members[name] = _with_header(members[name], pick(rng, HEADERS))
    elif kind == 3:
        data = bytearray(members[name])
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        members[name] = bytes(data)
    elif name == "header.npy" and rng.random() < 0.9:
        head = np.load(io.BytesIO(members[name])).tobytes()
        members[name] = _saved(np.frombuffer(mutate_json(rng, head), dtype=np.uint8))
    else:
        members[name] = _saved(_changed(rng, np.load(io.BytesIO(members[name]))))
    return _archive(rng, members)


def _with_header(member: bytes, header: bytes) -> bytes:
    """An array with another header of the same version, padded as NumPy does."""
    (length,) = struct.unpack("<H", member[8:10])
    return member[:8] + struct.pack("<H", len(header)) + header + member[10 + length :]


def _saved(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _changed(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """Other values, another type or another shape."""
    kind = int(rng.integers(6))
    if array.dtype.names:
        field = pick(rng, array.dtype.names)
        array = array.copy()
        array[field] = _changed_values(rng, array[field])
        return array
    if kind == 0:
        return array[:-1] if array.ndim else array.reshape(1)
    if kind == 1:
        return array[None]
    if kind == 2 and array.dtype.kind in "iufb":
        return array.astype(pick(rng, ("f8", "f4", "i8", "i1", "u1", "?", "c8", "U8")))
    if kind == 3:
        return np.zeros((0, *array.shape[1:]), dtype=array.dtype)
    return _changed_values(rng, array)


def _changed_values(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "iufb" or not array.size:
        return array
    changed, value = array.copy(), pick(rng, WRONG)
    if array.dtype.kind in "iu":
        limits = np.iinfo(array.dtype)
        value = limits.max if not value < limits.max else max(value, limits.min)
    flat = changed.reshape(-1)
    with np.errstate(over="ignore"):
        flat[int(rng.integers(flat.size)) :: pick(rng, (flat.size, 7, 1))] = value
    return changed


def _archive(rng: np.random.Generator, members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        if rng.random() < 0.03 and "bomb.npy" not in members:  # 64 MiB in 64 KiB
            archive.writestr("bomb.npy", bytes(1 << 26))
    data = bytearray(file.getvalue())
    if rng.random() < 0.1:  # a size in the directory at the end
        at = data.rfind(b"PK\1\2") + 24
        data[at : at + 4] = struct.pack("<I", pick(rng, (0, 1, 2**31, 2**32 - 2)))
    return bytes(data)


def mutate_safetensors(rng: np.random.Generator, content: bytes) -> bytes:
    """Changes the header of tensors, its length, or some of their numbers."""
    (length,) = struct.unpack("<Q", content[:8]) if len(content) > 8 else (0,)
    head, body = content[8 : 8 + length], bytearray(content[8 + length :])
    kind = int(rng.integers(4))
    if kind == 0:
        length = int(pick(rng, (0, 1, 2**31, 2**62, 2**64 - 1, length + 8)))
        return struct.pack("<Q", length) + head + bytes(body)
    if kind == 1:
        head = mutate_json(rng, head)
    elif kind == 2 and len(body) >= 4:
        with np.errstate(over="ignore"):
            wrong = np.array(pick(rng, WRONG)).astype(np.float32).tobytes()
        for _ in range(int(rng.integers(1, 9))):
            at = 4 * int(rng.integers(len(body) // 4))
            body[at : at + 4] = wrong
    elif body:
        for _ in range(9):
            body[int(rng.integers(len(body)))] = int(rng.integers(256))
    return struct.pack("<Q", len(head)) + head + bytes(body)
