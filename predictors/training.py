"""The command `asp-env train`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from asp_env.errors import MissingExtraError


@dataclass(frozen=True, slots=True, kw_only=True)
class Train:
    """Train a predictor; a run that was killed goes on where its last epoch ended."""

    predictor: Annotated[str, tyro.conf.Positional]
    """Which one, such as ffw-asp."""
    data: Annotated[str, tyro.conf.Positional]
    """A folder with recordings, or a source such as synthetic:intersection."""
    out: Path
    """Folder of the run."""
    preset: str = "cpu"
    """cpu (minutes on two cores) or paper (the paper's network and schedule)."""
    view: str = "chauffeurnet"
    """What the network looks at."""
    horizon: float = 3.0
    """How far it forecasts, seconds."""
    split: Literal["recording", "blocks"] = "recording"
    """What is held out: whole recordings, or blocks of time within each."""
    epochs: int | None = None
    """Instead of the preset's."""
    seed: int = 0
    """Of the initial weights and the order of the data."""
    max_snippets: int | None = None
    """Learn from no more than so many, chosen at random."""

    def run(self) -> None:
        """Trains.

        Raises:
            AspEnvError: an option, the data or the folder is bad.
        """
        try:
            from predictors.fitting import train
            from predictors.recipes import recipe
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "train", "training") from error

        config = recipe(self.predictor, self.preset, view=self.view, horizon_s=self.horizon)
        config = dataclasses.replace(
            config,
            split=self.split,
            seed=self.seed,
            max_snippets=self.max_snippets,
            epochs=config.epochs if self.epochs is None else self.epochs,
        )
        run = train(config, self.data, self.out)
        Console().print(f"wrote {run}: name it as {self.predictor}:{run}")
