"""Atomic folders and files: complete or absent, and nothing temporary remains."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.files import atomic_file, atomic_folder, check_new, is_vacant, remove_abandoned


def everything(folder: Path) -> list[str]:
    """Relative paths of all files and folders below a folder."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def write_folder(out: Path, *, error: BaseException | None = None) -> None:
    with atomic_folder(out) as folder:
        (folder / "file").write_text("words")
        if error is not None:
            raise error


def write_file(path: Path, text: str, *, error: BaseException | None = None) -> None:
    with atomic_file(path) as partial:
        partial.write_text(text)
        if error is not None:
            raise error


def test_a_folder_appears_at_the_end(tmp_path):
    """Neither it nor its missing parent folders exist while it is written."""
    out = tmp_path / "deep" / "down" / "out"
    with atomic_folder(out) as folder:
        (folder / "file").write_text("words")
        assert not out.parent.exists()
    assert everything(tmp_path) == ["deep", "deep/down", "deep/down/out", "deep/down/out/file"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, FileNotFoundError])
def test_an_exception_leaves_no_folder(tmp_path, error):
    with pytest.raises(error):
        write_folder(tmp_path / "deep" / "out", error=error())
    assert everything(tmp_path) == []


def test_an_empty_folder_is_taken(tmp_path):
    """After an exception it is still there, and empty."""
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(RuntimeError):
        write_folder(out, error=RuntimeError())
    assert everything(tmp_path) == ["out"]
    write_folder(out)
    assert everything(tmp_path) == ["out", "out/file"]


def test_existing_content_is_refused(tmp_path):
    """A folder that is not empty and a file stay unchanged; the error has one line."""
    full, file = tmp_path / "full", tmp_path / "file"
    full.mkdir()
    (full / "precious").write_text("words")
    file.write_text("words")
    for out in (full, file):
        with pytest.raises(AspEnvError, match=r"exists and is not an empty folder; [^\n]*$"):
            write_folder(out)
    assert everything(tmp_path) == ["file", "full", "full/precious"]
    assert (full / "precious").read_text() == file.read_text() == "words"


def test_a_folder_that_is_filled_meanwhile_is_not_replaced(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(AspEnvError, match="cannot be written"), atomic_folder(out):
        write_folder(out)
    assert everything(tmp_path) == ["out", "out/file"]


def test_an_unwritable_folder_is_refused(tmp_path):
    """Below a file, where the system permits no folders, and on a full disk: one line."""
    file = tmp_path / "file"
    file.write_text("words")
    for out in (file / "below", Path("/proc/asp-env-out")):
        with pytest.raises(AspEnvError, match=r"cannot be written \([^\n]*$"):
            write_folder(out)
    with pytest.raises(AspEnvError, match=r"out cannot be written \(No space left on device\)"):
        write_folder(tmp_path / "out", error=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert everything(tmp_path) == ["file"]


def test_a_new_path_is_checked_before_anything_is_written(tmp_path):
    """A missing parent folder is no fault; a file in the way, and what exists already, are."""
    file = tmp_path / "file"
    file.write_text("words")
    check_new(tmp_path / "new" / "deep")
    with pytest.raises(AspEnvError, match="file exists; choose another name or remove it"):
        check_new(file)
    for path in (file / "below", file / "far" / "below", Path("/proc/version/out")):
        with pytest.raises(AspEnvError, match=r"cannot be written \([^\n]*; choose another path$"):
            check_new(path)
    assert everything(tmp_path) == ["file"]


def test_relative_paths_belong_to_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_folder(Path("out"))
    write_file(Path("file"), "words")
    assert everything(tmp_path) == ["file", "out", "out/file"]


def test_a_file_appears_at_the_end(tmp_path):
    path = tmp_path / "deep" / "file"
    with atomic_file(path) as partial:
        partial.write_text("words")
        assert not path.parent.exists()
    assert path.read_text() == "words"
    assert everything(tmp_path) == ["deep", "deep/file"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, OSError])
def test_an_exception_leaves_the_file_as_it_was(tmp_path, error):
    """Absent, or with its old content."""
    path = tmp_path / "file"
    with pytest.raises(error):
        write_file(path, "new", error=error())
    assert everything(tmp_path) == []
    write_file(path, "old")
    with pytest.raises(error):
        write_file(path, "new", error=error())
    assert path.read_text() == "old"
    assert everything(tmp_path) == ["file"]


def test_a_file_that_cannot_be_written(tmp_path):
    """A folder in its place, and a path below a file."""
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write_file(tmp_path / "folder", "words")
    write_file(tmp_path / "file", "words")
    with pytest.raises(NotADirectoryError):
        write_file(tmp_path / "file" / "below", "words")
    assert everything(tmp_path) == ["file", "folder"]


def test_permissions_are_those_of_ordinary_files(tmp_path):
    (tmp_path / "ordinary folder").mkdir()
    (tmp_path / "ordinary file").touch()
    write_folder(tmp_path / "folder")
    write_file(tmp_path / "file", "words")
    for kind in ("folder", "file"):
        assert (tmp_path / kind).stat().st_mode == (tmp_path / f"ordinary {kind}").stat().st_mode


def test_arrays_have_the_bytes_of_an_ordinary_write(tmp_path):
    arrays = {"a": np.arange(1000.0), "b": np.zeros((3, 0), dtype=np.int8)}
    np.savez_compressed(tmp_path / "ordinary.npz", **arrays)
    with atomic_file(tmp_path / "atomic.npz") as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    assert (tmp_path / "atomic.npz").read_bytes() == (tmp_path / "ordinary.npz").read_bytes()


WRITER = """
import sys
from pathlib import Path
from asp_env.files import atomic_file

path, letter = Path(sys.argv[1]), sys.argv[2]
print("ready", flush=True)
sys.stdin.readline()
for _ in range(200):
    with atomic_file(path) as partial:
        partial.write_text(letter * 100_000)
"""


def test_two_processes_write_one_file(tmp_path):
    """Both end well, and every reader sees the complete content of one of them."""
    path = tmp_path / "file"
    writers = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), letter],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for letter in "ab"
    ]
    complete = {letter * 100_000 for letter in "ab"}
    for writer in writers:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
    for writer in writers:
        assert writer.stdin is not None
        writer.stdin.write("go\n")
        writer.stdin.flush()
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            assert path.read_text() in complete
    assert [writer.communicate(timeout=60)[1] for writer in writers] == ["", ""]
    assert [writer.returncode for writer in writers] == [0, 0]
    assert path.read_text() in complete
    assert everything(tmp_path) == ["file"]


HOLDER = """
import sys
from pathlib import Path
from asp_env.files import atomic_file, atomic_folder

out = Path(sys.argv[1])
with atomic_folder(out / "folder") as folder, atomic_file(out / "file") as file:
    (folder / "inner").write_text("words")
    file.write_text("words")
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that is writing the file `file` and the folder `folder` in `tmp_path`."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


def test_what_killed_processes_left_is_removed(tmp_path, holder):
    """By the next one that writes into the same folder; not while the process runs."""
    for name in (".own.partial", ".own.0123.partial", "own"):
        (tmp_path / name).write_text("not of this module")
    before = everything(tmp_path)
    assert len(before) == 6
    remove_abandoned(tmp_path)
    assert everything(tmp_path) == before
    assert is_vacant(tmp_path / "folder")

    holder.kill()
    holder.wait()
    assert everything(tmp_path) == before
    write_file(tmp_path / "another", "words")
    assert everything(tmp_path) == [".own.0123.partial", ".own.partial", "another", "own"]


def test_a_folder_of_leftovers_alone_is_vacant(tmp_path, holder):
    """It is taken like an empty one once their process has ended."""
    holder.kill()
    holder.wait()
    assert is_vacant(tmp_path)
    assert not is_vacant(next(tmp_path.glob(".folder.*")))
    write_folder(tmp_path)
    assert everything(tmp_path) == ["file"]


def test_a_link_with_the_name_of_a_leftover_is_not_followed(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").write_text("words")
    (tmp_path / ".out.0123456789ab.partial").symlink_to(tmp_path / "precious")
    remove_abandoned(tmp_path)
    assert (tmp_path / "precious" / "file").read_text() == "words"


def test_two_threads_take_and_remove_at_the_same_time(tmp_path):
    """A file that is being written is never taken for a leftover."""
    stop = Event()

    def remove():
        while not stop.is_set():
            remove_abandoned(tmp_path)

    thread = Thread(target=remove)
    thread.start()
    try:
        for number in range(300):
            write_file(tmp_path / str(number), "words")
            write_folder(tmp_path / f"folder{number}")
    finally:
        stop.set()
        thread.join()
    assert len(everything(tmp_path)) == 900


def test_an_error_that_names_no_file_names_the_target(tmp_path):
    """As on a full disk; in a folder the file within it."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(OSError, match="No space left") as caught:
        write_file(tmp_path / "file", "words", error=full)
    assert caught.value.filename == str(tmp_path / "file")

    def write_within():
        with atomic_folder(tmp_path / "out") as folder:
            write_file(folder / "within", "words", error=full)

    expected = re.escape(f"{tmp_path}/out/within cannot be written (No space left on device); free")
    full.filename = None
    with pytest.raises(AspEnvError, match=expected):
        write_within()
    assert everything(tmp_path) == []
