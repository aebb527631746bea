"""JSON and arrays from files that may be damaged, cut or made by others.

`json.loads` fails in other ways than by `ValueError` if brackets are nested deeply. `numpy.load`
allocates whatever size a header claims, and its parser of headers raises errors of the tokenizer.
The functions of this module raise one kind of error each, before anything large is allocated.
"""

import json
import math
import types
import typing
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal

import numpy as np

from asp_env.errors import DataError

MAX_ARRAYS_BYTES = 1 << 30
"""Largest size of all arrays of a file together. Chosen by hand: rollouts of a minute with hundreds
of agents have megabytes, and a small archive can stand for any size."""

WHOLE_BELOW = 2**53
"""Whole numbers of fields must be below, as in other readers of JSON."""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_DAMAGE = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, TokenError),
    RuntimeError,  # an encrypted archive, or an unknown compression method
    UserWarning,  # a header of Python 2
)
_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    types.NoneType: "nothing",
}


def parse_json(content: bytes | str) -> Any:
    """Parses JSON.

    Raises:
        ValueError: the content is not JSON, or nested too deeply to be read.
    """
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads all arrays of an `.npz` file, none of which is unpickled.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, of another kind, or larger than `MAX_ARRAYS_BYTES`. The
            message does not name it.
    """
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(path) as archive:
            warnings.simplefilter("error", UserWarning)
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > MAX_ARRAYS_BYTES:
                raise ValueError(f"{size:,} bytes of arrays, expected {MAX_ARRAYS_BYTES:,} at most")
            arrays = {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
            if len(arrays) < len(members):
                raise ValueError("two arrays have the same name")
            return arrays
    except FileNotFoundError:
        raise
    except _DAMAGE as error:
        raise ValueError(brief(error)) from error


def check_fields(kind: type, values: Any) -> None:
    """Checks that values have the types of a dataclass's fields, as far as JSON has types.

    Lists stand for tuples. Numbers are finite, and whole numbers below `WHOLE_BELOW`. Fields of
    other types, and those that the dataclass lacks, are not checked.

    Args:
        kind: the dataclass.
        values: values by the name of the field.

    Raises:
        DataError: `values` is no mapping, or a value has another type. The message names the
            field, without the file.
    """
    if not isinstance(values, Mapping):
        raise DataError(f"{brief(repr(values))}: expected an object with fields of {kind.__name__}")
    hints = typing.get_type_hints(kind)
    for name, value in values.items():
        if name in hints and not _fits(value, hints[name]):
            raise DataError(f"{name} is {brief(repr(value))}, expected {_words(hints[name])}")


def brief(what: object) -> str:
    """An error or a text as one line of at most 120 characters."""
    text = " ".join(str(what).split()) or type(what).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """The array of a member, whose header must agree with the size of its content."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"{member.filename}: arrays of version {version}")
        shape, fortran, dtype = _HEADERS[version](file)
        count, available = math.prod(shape), member.file_size - file.tell()
        if dtype.hasobject:
            raise ValueError(f"{member.filename}: holds objects, which are not unpickled")
        if min(shape, default=0) < 0 or not dtype.itemsize or count * dtype.itemsize != available:
            raise ValueError(
                f"{member.filename}: {available:,} bytes for an array {shape} of {dtype}"
            )
        content = bytearray(file.read())  # of all, so that the checksum of the member is compared
    if len(content) != available:
        raise ValueError(f"{member.filename}: ends after {len(content):,} bytes")
    array = np.frombuffer(content, dtype=dtype)
    return array.reshape(shape[::-1]).transpose() if fortran else array.reshape(shape)


def _fits(value: object, hint: Any) -> bool:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts and type(value) in map(type, parts)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False
        inner = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        return len(value) == len(inner) and all(map(_fits, value, inner))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            isinstance(key, str) and _fits(each, parts[1]) for key, each in value.items()
        )
    if hint is int:
        if not isinstance(value, int) or isinstance(value, bool):
            return False
        return abs(value) < WHOLE_BELOW
    if hint is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            return False
        return abs(value) < math.inf
    return isinstance(value, hint) if hint in (bool, str, types.NoneType) else True


def _words(hint: Any) -> str:
    """What a value should be, for messages."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_words, parts))
    if origin is Literal:
        return f"one of {', '.join(map(repr, parts))}"
    if origin is tuple:
        return "a list" if parts[-1] is Ellipsis else f"a list of {len(parts)}"
    return _WORDS.get(hint, "an object")
