"""Makes the sample recordings that ship with `asp_env`: `python -m scenarios.synthesize OUT`.

Give a new folder and put what is in it into `asp_env/samples`. One recording of two minutes for
each site, tracks compressed.

MERGED: The command `synthesize`: traffic made by a simulator, as recordings.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from asp_env.errors import AspEnvError, MissingExtraError
from scenarios.sumo.dataset import synthesize

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


HIGHWAY = "highway:"
"""Before the names of highway-env's sites."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Synthesize:
    """Write traffic made by SUMO or highway-env, in the inD layout.

    Attributes:
        out: folder to make.
        site: `intersection` (crossroads and T-junctions) or `roundabout` (one lane and two) of
            SUMO, `highway:intersection` or `highway:roundabout` of highway-env.
        recordings: how many recordings.
        minutes: length of each.
        seed: same seed, same bytes.
        noise: add measurement errors, smoothed as drone datasets are; the truth goes to `truth/`.
        locations: how many places; by default one for every three recordings. A site of
            highway-env is a single place.
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
        if self.site.startswith(HIGHWAY):
            self._run_highway(self.site.removeprefix(HIGHWAY))
            return
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

    def _run_highway(self, site: str) -> None:
        if self.locations not in (None, 1):
            raise AspEnvError(
                f"--locations {self.locations}: {self.site} is a single place; leave it out"
            )
        try:
            from scenarios.highway import dataset
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "highway", f"--site {self.site}") from error
        dataset.synthesize(
            self.out,
            site=site,
            recordings=self.recordings,
            minutes=self.minutes,
            seed=self.seed,
            noise=self.noise,
            progress=True,
        )
