"""What the registry finds here: the source `highway:`."""

from pathlib import Path

from asp_env.errors import AspEnvError, unknown_name
from scenarios.highway.dataset import synthesize
from scenarios.highway.history import FOLDER
from scenarios.highway.sites import SITES
from scenarios.kept import made_once

SOURCE_RECORDINGS, SOURCE_MINUTES, SOURCE_SEED = 6, 2.0, 90_521
"""What `highway:SITE` consists of."""
SOURCE_VERSION = 1
"""Raise when other bytes come of the same seed, so that nobody mixes them with cached ones."""


def open_source(argument: str) -> Path:
    """The folder of `highway:ARGUMENT`.

    Args:
        argument: `intersection` or `roundabout`, made on first use in the user's cache folder; or a
            folder that `asp-env synthesize OUT --site highway:…` made.

    Raises:
        AspEnvError: an unknown site, a folder of something else, or a cache folder that cannot be
            written.
    """
    if argument in SITES:
        return made_once(
            "highway",
            f"{argument}-{SOURCE_VERSION}",
            lambda folder: synthesize(
                folder,
                site=argument,
                recordings=SOURCE_RECORDINGS,
                minutes=SOURCE_MINUTES,
                seed=SOURCE_SEED,
                progress=True,
            ),
        )
    folder = Path(argument).expanduser()
    if not argument or not folder.is_dir():
        raise unknown_name("highway site or folder", argument, SITES)
    if not (folder / FOLDER).is_dir():
        raise AspEnvError(
            f"highway:{argument}: {folder / FOLDER} is missing; expected a folder made by `asp-env "
            "synthesize OUT --site highway:…`; without what the vehicles had in mind it can only "
            f"be replayed: use {argument} itself"
        )
    return folder.absolute()
