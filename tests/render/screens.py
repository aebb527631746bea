"""A virtual X screen and its content."""

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
"""Positions of values in the header of an X window dump, in words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """A running X server."""

    display: str
    dump: Path

    @property
    def environment(self) -> dict[str, str]:
        """The environment of programs that open their windows on this screen."""
        return os.environ | {"DISPLAY": self.display, "SDL_VIDEODRIVER": "x11"}

    def look(self) -> UInt8[np.ndarray, "height width 3"]:
        """The RGB content of the screen, from the X window dump that the server maintains."""
        content = self.dump.read_bytes()
        head = np.frombuffer(content, dtype=">u4", count=HEADER_WORDS).tolist()
        start = head[0] + 12 * head[COLOURS]
        lines = np.frombuffer(content[start:], dtype=np.uint8)[: head[HEIGHT] * head[LINE_BYTES]]
        pixels = lines.reshape(head[HEIGHT], -1, 4)[:, : head[WIDTH]]
        return pixels[..., 2::-1]


@contextmanager
def open_screen(folder: Path) -> Iterator[Screen]:
    """A screen of 1000 by 800 pixels; skips the test if Xvfb is not installed."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1000x800x24", "-fbdir", str(folder)]
    server = subprocess.Popen(
        [*command, "-nolisten", "tcp"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert server.stdout is not None
        number = server.stdout.readline().strip()
        yield Screen(display=f":{number}", dump=folder / "Xvfb_screen0")
    finally:
        server.terminate()
        server.wait()
        if server.stdout is not None:
            server.stdout.close()
