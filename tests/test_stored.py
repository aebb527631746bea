"""JSON, arrays and fields of damaged files: one kind of error, and no large allocation."""

import contextlib
import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import hypothesis.extra.numpy as npst
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.errors import DataError
from asp_env.stored import MAX_ARRAYS_BYTES, check_fields, parse_json, read_arrays


@given(content=st.binary() | st.text())
def test_any_content_is_json_or_a_value_error(content: bytes | str) -> None:
    with contextlib.suppress(ValueError):
        parse_json(content)


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"a":' * 100_000, b"[" * 9999 + b"]" * 9999])
def test_deep_json_is_a_value_error(content: bytes) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(content)


ARRAYS = npst.arrays(
    st.sampled_from([np.float32, np.int64, np.bool_, np.uint8, "<U3"]),
    npst.array_shapes(min_side=0),
)


@given(arrays=st.dictionaries(st.sampled_from(["a", "b", "ä"]), ARRAYS), turned=st.booleans())
def test_arrays_are_read_as_numpy_does(
    tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray], turned: bool
) -> None:
    """Bit for bit, of any shape and order of memory."""
    path = tmp_path_factory.mktemp("arrays") / "a.npz"
    given = {name: np.asfortranarray(each) if turned else each for name, each in arrays.items()}
    np.savez_compressed(path, **given)  # pyright: ignore[reportArgumentType]
    found = read_arrays(path)
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


def write_member(path: Path, header: bytes, content: bytes = bytes(16)) -> None:
    """Writes an `.npz` file of one array with any header."""
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", member)


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }", "16 bytes for"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (-4,), }", "16 bytes for"),
        ("{'descr': '|V0', 'fortran_order': False, 'shape': (4,), }", "16 bytes for"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", "holds objects"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (4L,), }", "Python 2"),
        ("(" * 900, "."),  # an error of the tokenizer
        ("{'descr': '''", "."),
        ("__import__('os').getcwd()", "."),
    ],
)
def test_headers_that_lie_are_refused(tmp_path: Path, header: str, reason: str) -> None:
    """No memory is allocated for what a header claims, and none of it is evaluated."""
    write_member(tmp_path / "a.npz", header.encode())
    with pytest.raises(ValueError, match=reason) as caught:
        read_arrays(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


def test_an_archive_that_stands_for_gigabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(3))
    content = bytearray(path.read_bytes())
    at = content.rfind(b"PK\1\2") + 24
    content[at : at + 4] = (MAX_ARRAYS_BYTES + 1).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match="1,073,741,825 bytes"):
        read_arrays(path)


@given(position=st.integers(0, 10**6), bit=st.integers(0, 7))
def test_a_flipped_bit_is_found_or_without_effect(
    tmp_path_factory: pytest.TempPathFactory, position: int, bit: int
) -> None:
    file = io.BytesIO()
    np.savez_compressed(file, a=np.arange(50.0))
    content = bytearray(file.getvalue())
    content[position % len(content)] ^= 1 << bit
    path = tmp_path_factory.mktemp("flipped") / "a.npz"
    path.write_bytes(content)
    try:
        found = read_arrays(path)
    except ValueError:
        return
    for array in found.values():  # the name of an array has no checksum
        np.testing.assert_array_equal(array, np.arange(50.0))


@pytest.mark.parametrize("values", [None, 3, "left", [], ["count"]])
def test_fields_of_something_else(values: object) -> None:
    with pytest.raises(DataError, match="expected an object with fields of Fields"):
        check_fields(Fields, values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fields:
    """One field of each kind."""

    count: int = 0
    length_m: float = 0.0
    shown: bool = False
    name: str | None = None
    size: tuple[int, int] = (1, 2)
    tags: tuple[str, ...] = ()
    kind: Literal["a", "b"] = "a"
    weights: Mapping[str, float] | None = None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("count", value) for value in (0, -3, 2**53 - 1)],
        *[("length_m", value) for value in (0.5, 3, -1e300)],
        *[("shown", True), ("name", None), ("name", "x"), ("size", [3, 4]), ("tags", [])],
        *[("tags", ["a"]), ("kind", "b"), ("weights", {"a": 1}), ("weights", None), ("other", 5)],
    ],
)
def test_values_of_the_right_type(name: str, value: Any) -> None:
    check_fields(Fields, {name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *[("count", value, "a whole number") for value in (8.5, 3.0, True, "3", None, 2**53)],
        *[("length_m", value, "a number") for value in (float("nan"), 1e999, True, "1", [1.0])],
        ("shown", 1, "true or false"),
        ("name", 3, "a text or nothing"),
        ("size", [1, 2, 3], "a list of 2"),
        ("size", [1, 2.5], "a list of 2"),
        ("tags", "abc", "a list"),
        ("kind", "c", "one of 'a', 'b'"),
        ("weights", {"a": "b"}, "an object"),
    ],
)
def test_values_of_another_type(name: str, value: Any, message: str) -> None:
    with pytest.raises(DataError, match=rf"^{name} is .*, expected .*{message}"):
        check_fields(Fields, {name: value})
