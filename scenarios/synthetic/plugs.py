"""What the registry finds here: the source `synthetic:`."""

from pathlib import Path

from asp_env.errors import unknown_name
from scenarios.kept import made_once
from scenarios.synthetic.dataset import synthesize
from scenarios.synthetic.place import SITES

SOURCE_RECORDINGS, SOURCE_MINUTES, SOURCE_SEED = 8, 5.0, 90_521
"""What `synthetic:` consists of. The seed decides the places: one that nobody else takes."""
SOURCE_VERSION = 2
"""Raise when other bytes come of the same seed, so that nobody mixes them with cached ones."""


def open_source(argument: str) -> Path:
    """The folder of `synthetic:ARGUMENT`, made on first use in the user's cache folder.

    Args:
        argument: `intersection` or `roundabout`.

    Raises:
        AspEnvError: an unknown site, or a cache folder that cannot be written.
    """
    if argument not in SITES:
        raise unknown_name("synthetic site", argument, SITES)
    return made_once(
        "synthetic",
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
