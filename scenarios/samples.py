"""Makes the sample recordings that ship with `asp_env`: `python -m scenarios.samples OUT`.

Give a new folder and put what is in it into `asp_env/samples`. One recording of two minutes for
each site, tracks compressed.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from scenarios.synthetic import synthesize

SEEDS = {"intersection": 14, "roundabout": 0}
"""Chosen by eye: all classes and all turns occur, nothing jams."""
MINUTES = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Write the sample recordings.

    Attributes:
        out: folder to make.
    """

    out: tyro.conf.Positional[Path]

    def run(self) -> None:
        """Writes one folder for each site."""
        for site, seed in SEEDS.items():
            synthesize(
                self.out / site,
                site=site,
                recordings=1,
                minutes=MINUTES,
                seed=seed,
                compress=True,
                progress=True,
            )


if __name__ == "__main__":
    tyro.cli(Samples).run()
