"""The command `asp-env synthesize`, and the sample recordings that ship with `asp_env`.

`python -m scenarios.synthesize OUT` generates the samples; the content of OUT belongs in
`asp_env/samples`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from asp_env.errors import AspEnvError, MissingExtraError
from scenarios.sumo.dataset import synthesize
from scenarios.sumo.demand import Traffic

SEEDS = {"intersection": 14, "roundabout": 0}
"""Chosen by viewing: all classes and all turns occur, and traffic does not jam."""
MINUTES = 2.0

HIGHWAY = "highway:"
"""Prefix of the names of highway-env's sites."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Generate the sample recordings that ship with `asp_env`.

    Attributes:
        out: Folder to create.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]

    def run(self) -> None:
        """Writes one folder per site: one recording of two minutes with compressed tracks."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Synthesize:
    """Generate traffic with SUMO or highway-env, in the inD layout.

    Attributes:
        out: Folder to create.
        site: Site of SUMO, `intersection` (crossroads and T-junctions) or `roundabout` (one and
            two lanes), or of highway-env, `highway:intersection` or `highway:roundabout`.
        recordings: Number of recordings.
        minutes: Length of each recording in minutes.
        seed: Seed of the generator; the same seed gives the same bytes.
        noise: Add measurement errors and smooth them as in drone datasets. The true tracks are
            written to `truth/`.
        locations: Number of locations; by default one for every three recordings. A site of
            highway-env has a single location.
        traffic: `normal`, or `dense`: vehicles follow each other after 3 to 6 s on the main road,
            more of them turn left across oncoming traffic, drivers differ in whether they yield,
            and vehicles leave two-lane roundabouts from both lanes; or `varied`: geometry, limits,
            classes, drivers, maps and trackers are drawn from wide ranges for each location. Sites
            of SUMO only.
        jobs: Number of processes; the bytes do not depend on it.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    site: str = "intersection"
    recordings: int = 10
    minutes: float = 10.0
    seed: int = 0
    noise: bool = False
    locations: int | None = None
    traffic: Traffic = "normal"
    jobs: int = 1

    def run(self) -> None:
        """Writes the folder.

        Raises:
            AspEnvError: the site is unknown, a number is out of range, or the folder cannot be
                written.
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
            traffic=self.traffic,
            jobs=self.jobs,
            progress=True,
        )

    def _run_highway(self, site: str) -> None:
        if self.locations not in (None, 1):
            raise AspEnvError(
                f"--locations {self.locations}: {self.site} has a single location; leave it out"
            )
        if self.traffic != "normal":
            raise AspEnvError(
                f"--traffic {self.traffic}: {self.site} has traffic of its own; leave it out"
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
            jobs=self.jobs,
            progress=True,
        )


if __name__ == "__main__":
    tyro.cli(Samples).run()
