"""What the registry finds here: the command `synthesize` and the source `synthetic:`."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from asp_env.data.cache import cache_folder
from asp_env.errors import AspEnvError, unknown_name
from scenarios.synthetic.dataset import synthesize
from scenarios.synthetic.place import SITES

SOURCE_RECORDINGS, SOURCE_MINUTES, SOURCE_SEED = 8, 5.0, 90_521
"""What `synthetic:` consists of. The seed decides the places: one that nobody else takes."""
SOURCE_VERSION = 2
"""Raise when other bytes come of the same seed, so that nobody mixes them with cached ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Synthesize:
    """Write traffic made by SUMO, in the inD layout.

    Attributes:
        out: folder to make.
        site: `intersection` (crossroads and T-junctions) or `roundabout` (one lane and two).
        recordings: how many recordings.
        minutes: length of each.
        seed: same seed, same bytes.
        noise: add measurement errors, smoothed as drone datasets are; the truth goes to `truth/`.
        locations: how many places; by default one for every three recordings.
    """

    out: tyro.conf.Positional[Path]
    site: str = "intersection"
    recordings: int = 10
    minutes: float = 10.0
    seed: int = 0
    noise: bool = False
    locations: int | None = None

    def run(self) -> None:
        """Writes the folder.

        Raises:
            AspEnvError: an unknown site, an impossible number, or a folder that cannot be written.
        """
        synthesize(
            self.out,
            site=self.site,
            recordings=self.recordings,
            minutes=self.minutes,
            seed=self.seed,
            noise=self.noise,
            locations=self.locations,
            progress=True,
        )


def open_source(argument: str) -> Path:
    """The folder of `synthetic:ARGUMENT`, made on first use in the user's cache folder.

    Several processes may ask at once: the first to finish wins, the others take what it made.

    Args:
        argument: `intersection` or `roundabout`.

    Raises:
        AspEnvError: an unknown site, or a cache folder that cannot be written.
    """
    if argument not in SITES:
        raise unknown_name("synthetic site", argument, SITES)
    shelf = cache_folder() / "synthetic"
    folder = shelf / f"{argument}-{SOURCE_VERSION}"
    if folder.is_dir():
        return folder
    try:
        shelf.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=shelf, prefix=f".{argument}-") as aside:
            made = Path(aside) / "made"
            synthesize(
                made,
                site=argument,
                recordings=SOURCE_RECORDINGS,
                minutes=SOURCE_MINUTES,
                seed=SOURCE_SEED,
                progress=True,
            )
            if not folder.is_dir():
                os.rename(made, folder)
    except OSError as error:
        if not folder.is_dir():  # else another process was faster
            raise AspEnvError(f"cannot write to {shelf}: {error.strerror or error}") from error
    return folder
