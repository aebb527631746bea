"""Seeded mutations of files: what a copy, another program, an editor or malice does to them.

Each mutation takes a generator and the content of a file, and returns other content; `mutate_file`
chooses one that fits the kind of file. The same generator gives the same content.
"""

import itertools
import re
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.campaigns.arrays import mutate_npz, mutate_safetensors
from tests.campaigns.numbers import NUMBERS, mutate_json, pick

Mutation = Callable[[np.random.Generator, bytes], bytes]


def mutate_file(rng: np.random.Generator, path: Path) -> str:
    """Replaces a file by a mutation of it.

    Args:
        rng: generator.
        path: the file.

    Returns:
        The name of the mutation.
    """
    kinds = MUTATIONS.get(path.suffix.lower(), ())
    general = rng.random() < 0.3 or not kinds
    mutation = pick(rng, BYTES if general else kinds)
    content = path.read_bytes()
    try:
        path.write_bytes(mutation(rng, content))
    except Exception:  # a mutation of the structure of a file that is already damaged
        mutation = _flip_bit
        path.write_bytes(mutation(rng, content))
    return mutation.__name__.lstrip("_")


def mutate_folder(rng: np.random.Generator, folder: Path) -> str:
    """Changes the files of a folder in other ways than by their content: names, links, kinds."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = pick(rng, files)
    name = path.name
    if rng.random() < 0.4:
        mark = pick(rng, ("²", "٣", " ", "%", "..", "a" * 200, "[x]", "\u202e", "-", "'", "#"))
        path.rename(path.with_name(pick(rng, (mark + name, name.replace("0", mark, 1) or mark))))
        return "renamed"
    target = pick(rng, files)
    kind = pick(
        rng,
        ("removed", "folder", "loop", "dangling", "device", "fifo", "swapped", "empty", "twice"),
    )
    content = path.read_bytes()
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "dangling":
        path.symlink_to("../../../nowhere/at/all")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "fifo":
        import os

        os.mkfifo(path)
    elif kind == "swapped" and target != path:
        path.write_bytes(target.read_bytes())
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "twice":
        path.write_bytes(content)
        (path.parent / f"copy of {name}").write_bytes(content)
    return kind


def _span(rng: np.random.Generator, length: int) -> slice:
    """A random range, most often short."""
    first = int(rng.integers(0, max(length, 1)))
    return slice(first, first + int(min(rng.geometric(0.05), length)))


def _flip_bit(rng: np.random.Generator, content: bytes) -> bytes:
    data = bytearray(content or b"\0")
    for _ in range(int(rng.integers(1, 4))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _cut(rng: np.random.Generator, content: bytes) -> bytes:
    return content[: int(rng.integers(0, len(content) + 1))]


def _lose(rng: np.random.Generator, content: bytes) -> bytes:
    data = bytearray(content)
    del data[_span(rng, len(data))]
    return bytes(data)


def _overwrite(rng: np.random.Generator, content: bytes) -> bytes:
    data, span = bytearray(content), _span(rng, len(content))
    fill = pick(rng, (b"\0", b"\xff", b" ", b"\n", b"9", None))
    size = len(data[span])
    data[span] = rng.bytes(size) if fill is None else fill * size
    return bytes(data)


def _insert(rng: np.random.Generator, content: bytes) -> bytes:
    what = pick(rng, (b"\0", b"\xef\xbb\xbf", b"\r", b'"', b"\xff\xfe", b"\x1a", b"<!--", b"\n\n"))
    at = int(rng.integers(0, len(content) + 1))
    return content[:at] + what + content[at:]


def _repeat(rng: np.random.Generator, content: bytes) -> bytes:
    span = _span(rng, len(content))
    return content[: span.stop] + content[span.start :]


def _recode(rng: np.random.Generator, content: bytes) -> bytes:
    return content.decode("utf-8", "replace").encode(pick(rng, ("utf-16", "utf-32", "utf-8-sig")))


def _zip(rng: np.random.Generator, content: bytes) -> bytes:
    del rng
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + zlib.compress(content)[2:]


BYTES: Sequence[Mutation] = (
    *(_flip_bit, _flip_bit, _cut, _lose, _overwrite, _insert, _repeat, _recode, _zip),
)


def _move_line(
    rng: np.random.Generator, lines: list[bytes], first: int, last: int, *, kinds: int
) -> tuple[int, int]:
    """Draws a line and a kind of change; kinds 0 to 2 remove, repeat or exchange it in place.

    Args:
        rng: generator.
        lines: the lines of a file, changed.
        first: index of the first line that may be drawn.
        last: index behind the last one.
        kinds: number of kinds of change.

    Returns:
        The index of the line, and the kind.
    """
    a, b = (int(rng.integers(first, last)) for _ in range(2))
    kind = int(rng.integers(kinds))
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(b, lines[a])
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    return a, kind


def _rows(rng: np.random.Generator, content: bytes) -> bytes:
    """Removes, repeats, exchanges, shuffles or cuts rows."""
    lines = content.splitlines(keepends=True) or [b""]
    a, kind = _move_line(rng, lines, 0, len(lines), kinds=8)
    if kind == 3:
        lines[1:] = [lines[1:][i] for i in rng.permutation(len(lines) - 1)]
    elif kind == 4:
        lines[a] = lines[a][: len(lines[a]) // 2] + b"\n"
    elif kind == 5:
        del lines[1:]
    elif kind == 6:
        lines = lines[: 1 + len(lines) // 2] * 2
    elif kind == 7:
        lines[a] = lines[a].rstrip(b"\n") + pick(rng, (b",", b",1,2", b'"', b"\t")) + b"\n"
    return b"".join(lines)


def _columns(rng: np.random.Generator, content: bytes) -> bytes:
    """Renames, removes, exchanges, empties, scales, fills or repeats columns."""
    table = [line.split(b",") for line in content.splitlines()]
    width = len(table[0])
    a, b = (int(rng.integers(0, width)) for _ in range(2))
    header = list(table[0])
    special = pick(rng, NUMBERS).encode()
    factor = float(pick(rng, ("1e3", "1e6", "1e-3", "-1", "1e12", "57.29578", "0")))
    column = [row[a] for row in table[1:] if len(row) == width]
    odd = (b" " + header[a], header[a].upper(), header[b], b"", header[a] + b"\xe2")
    changes: Sequence[tuple[bytes, list[bytes]]] = (
        (pick(rng, odd), column),
        (header[b], column),
        (header[a], [row[b] for row in table[1:] if len(row) == width]),
        (header[a], [b""] * len(column)),
        (header[a], [special] * len(column)),
        (header[a], [_scaled(cell, factor) for cell in column]),
        (header[a], [_scaled(cell, factor) for cell in column]),
    )
    kind = int(rng.integers(len(changes) + 2))
    if kind >= len(changes):  # removed, or repeated at the end
        changed = [row[:a] + row[a + 1 :] if kind % 2 else [*row, row[a]] for row in table]
        return b"\n".join(b",".join(row) for row in changed) + b"\n"
    name, cells = changes[kind]
    for row, cell in zip(table, [name, *cells], strict=False):
        row[a] = cell
    return b"\n".join(b",".join(row) for row in table) + b"\n"


def _scaled(cell: bytes, factor: float) -> bytes:
    try:
        return repr(float(cell) * factor).encode()
    except ValueError:
        return cell


def _delimiters(rng: np.random.Generator, content: bytes) -> bytes:
    return content.replace(b",", pick(rng, (b";", b"\t", b", ", b" ,", b"|")))


def _number(rng: np.random.Generator, content: bytes) -> bytes:
    """Replaces a number, or several at equal distances, by one of `NUMBERS`."""
    found = [match.span() for match in re.finditer(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?", content)]
    if not found:
        return content
    new = pick(rng, NUMBERS).encode()
    first = int(rng.integers(len(found)))
    step = pick(rng, (len(found), len(found), 7, 2))
    data = bytearray(content)
    for begin, end in reversed(found[first::step]):
        data[begin:end] = new
    return bytes(data)


BOMB = (
    '<!DOCTYPE osm [<!ENTITY a "aaaaaaaaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 16}">' for a, b in itertools.pairwise("abcdefghi"))
    + "]>"
).encode()
"""Stands for 64 GiB of text."""

PROLOGS = (
    BOMB,
    b'<!DOCTYPE osm [<!ENTITY i SYSTEM "file:///etc/passwd">]>',
    b'<!DOCTYPE osm [<!ENTITY % p SYSTEM "http://127.0.0.1:9/x.dtd"> %p;]>',
    b'<!DOCTYPE osm SYSTEM "file:///dev/zero">',
    b'<!DOCTYPE osm [<!ATTLIST node lat CDATA "nan">]>',
    b"<!-- " + b"-" * 1000 + b" -->",
    b"<?php x ?>",
)


def _prolog(rng: np.random.Generator, content: bytes) -> bytes:
    """Puts a document type with entities before the root, which uses them."""
    body = re.sub(rb"<\?xml.*?\?>", b"", content, count=1)
    if rng.random() < 0.5:
        body = re.sub(rb"v='[a-z_]+'", b"v='&i;'", body, count=int(rng.integers(1, 4)))
    return b"<?xml version='1.0'?>" + pick(rng, PROLOGS) + body


def _encoding(rng: np.random.Generator, content: bytes) -> bytes:
    names = (
        *(
            "gbk",
            "base64",
            "utf-7",
            "utf-16",
            "idna",
            "rot13",
            "latin-1",
            "cp037",
            "unicode_escape",
        ),
        *("shift_jis", "x" * 500, "utf-32", "ascii", "punycode", "zlib", "hex", "undefined", ""),
    )
    declared = f"<?xml version='1.0' encoding='{pick(rng, names)}'?>".encode()
    return declared + re.sub(rb"<\?xml.*?\?>", b"", content, count=1)


def _elements(rng: np.random.Generator, content: bytes) -> bytes:
    """Removes, repeats, exchanges or nests elements, and changes references."""
    lines = content.splitlines(keepends=True)
    if len(lines) < 5:
        return _lose(rng, content)
    a, kind = _move_line(rng, lines, 2, len(lines) - 1, kinds=7)
    if kind == 3:
        lines.insert(a, b"<x>" * 20_000 + b"</x>" * 20_000)
    elif kind == 4:
        lines[a] = re.sub(rb"ref='\d+'", lambda _: b"ref='%d'" % rng.integers(1, 99), lines[a])
    elif kind == 5:
        lines[a] = re.sub(rb"(<nd [^>]*>)(.*)(<nd [^>]*>)", rb"\3\2\1", lines[a])
    elif kind == 6:
        lines[a] = re.sub(rb"(<nd [^>]*>|<member [^>]*>)", b"", lines[a], count=2)
    return b"".join(lines)


def _tags(rng: np.random.Generator, content: bytes) -> bytes:
    """Replaces a key, a value, a role or an attribute by another text."""
    texts = re.findall(rb"'([^']*)'", content)
    found = [
        match.span(1) for match in re.finditer(rb"(?:v|k|role|id|lat|lon|type)='([^']*)'", content)
    ]
    if not found:
        return content
    begin, end = pick(rng, found)
    odd = (
        b"",
        b"x" * 10_000,
        b"999999 mph",
        b"-5",
        b"1e999",
        b"&lt;b&gt;",
        b"\xf0\x9f\x9a\x97",
        b"no",
    )
    new = pick(rng, (*odd, *texts[:: max(1, len(texts) // 20)]))
    return content[:begin] + new + content[end:]


def _png_header(rng: np.random.Generator, content: bytes) -> bytes:
    """Other sizes, depths and colours in the header of a PNG, with the right checksum."""
    sides = (0, 1, 7, 4_096, 65_535, 2**20, 2**31 - 1, 2**32 - 1)
    fields = struct.pack(
        ">IIBBBBB",
        *(int(pick(rng, sides)) for _ in range(2)),
        int(pick(rng, (1, 2, 8, 16, 3))),
        int(pick(rng, (0, 2, 3, 4, 6, 5))),
        *(int(pick(rng, (0, 0, 0, 1))) for _ in range(3)),
    )
    chunk = b"IHDR" + fields
    return content[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[33:]


MUTATIONS: Mapping[str, Sequence[Mutation]] = {
    ".csv": (_rows, _columns, _columns, _delimiters, _number, _number, _number),
    ".osm": (_prolog, _encoding, _elements, _elements, _tags, _tags, _number, _number),
    ".json": (mutate_json, mutate_json, mutate_json, mutate_json, _number),
    ".npz": (mutate_npz,),
    ".safetensors": (mutate_safetensors,),
    ".png": (_png_header,),
    ".bin": (),
}
