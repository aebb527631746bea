"""A screen of X that nobody looks at, and what is on it."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import UInt8

HEADER_WORDS = 25
WIDTH, HEIGHT, LINE_BYTES, COLOURS = 4, 5, 12, 19
"""Which word of the header of an X window dump tells what."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """A running X server."""

    display: str
    picture: Path

    @property
    def environment(self) -> dict[str, str]:
        """For programs that are to show their windows on it."""
        return os.environ | {"DISPLAY": self.display, "SDL_VIDEODRIVER": "x11"}

    def look(self) -> UInt8[np.ndarray, "height width 3"]:
        """What it shows, in RGB: the server keeps it in a file, as an X window dump."""
        content = self.picture.read_bytes()
        head = np.frombuffer(content, dtype=">u4", count=HEADER_WORDS).tolist()
        at = head[0] + 12 * head[COLOURS]
        lines = np.frombuffer(content[at:], dtype=np.uint8)[: head[HEIGHT] * head[LINE_BYTES]]
        pixels = lines.reshape(head[HEIGHT], -1, 4)[:, : head[WIDTH]]
        return pixels[..., 2::-1]


@contextmanager
def open_screen(folder: Path) -> Iterator[Screen]:
    """A screen of 1000 by 800 pixels; skips the test where there is no Xvfb."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1000x800x24", "-fbdir", str(folder)]
    server = subprocess.Popen(
        [*command, "-nolisten", "tcp"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert server.stdout is not None
        number = server.stdout.readline().strip()
        yield Screen(display=f":{number}", picture=folder / "Xvfb_screen0")
    finally:
        server.terminate()
        server.wait()
        if server.stdout is not None:
            server.stdout.close()
