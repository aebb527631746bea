"""The command `asp-env train`; importing it needs neither torch nor Lightning."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from asp_env.errors import MissingExtraError


@dataclass(frozen=True, slots=True, kw_only=True)
class Train:
    """Train a predictor; an interrupted run resumes after its last complete epoch."""

    predictor: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PREDICTOR")]
    """Predictor to train: mtp, dkm, ffw-asp or ssp-asp."""
    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA …")]
    """Folders in the inD/rounD or INTERACTION layout, or
    sample:…, synthetic:… or highway:…. Several are trained on together."""
    out: Path
    """Folder of the run."""
    recipe: str = "cpu"
    """Recipe: cpu (the paper's structure, minutes on two
    cores), ours (more accurate at the same size) or paper
    (the paper's size and schedule)."""
    variant: str | None = None
    """Variant of the recipe by name, such as no-trail, for ablations."""
    view: str = "chauffeurnet"
    """View that the network observes: chauffeurnet, mtp or vectors."""
    horizon: float = 3.0
    """Horizon of the forecasts in seconds. Above 3 s, ssp-asp
    and the variant staged of the others start from a run for
    3 s in OUT/3s."""
    start: str | None = None
    """What to start from: a finished run, pretrained (the
    weights that ship with this package), or a safetensors
    file of ResNet18 weights."""
    validation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """Separate validation data. All of DATA is then used for training."""
    history: Literal["recorded", "causal"] = "recorded"
    """Histories that the network observes: as recorded
    (smoothed with later frames), or filtered again without
    later frames."""
    split: Literal["recording", "blocks"] = "recording"
    """What is held out: whole recordings, or blocks of time within each."""
    parked: bool = False
    """Train on parked vehicles, too."""
    epochs: int | None = None
    """Number of epochs instead of the recipe's; with two stages, the number for each."""
    seed: int = 0
    """Seed of the initial weights and of the order of the data."""
    max_snippets: int | None = None
    """Largest number of training snippets, chosen at random."""

    precision: Literal["32-true", "bf16-mixed"] | None = None
    """Precision of the encoder instead of the recipe's; the rest is always float32."""
    devices: int | Literal["auto"] = 1
    """Number of processes on each node, with a GPU each if
    there are GPUs; auto is one per GPU. The processes share
    every batch."""
    nodes: int = 1
    """Number of machines. The same command is started on each,
    with OUT and DATA in folders that all of them see, and
    with MASTER_ADDR, MASTER_PORT and NODE_RANK set, or by
    torchrun."""
    strategy: Literal["auto", "ddp"] = "auto"
    """Strategy of distributed training; ddp forces it even for a single process."""
    compile: bool = False
    """Compile the encoder with torch.compile, which takes tens of seconds at the start."""
    num_workers: int = 0
    """Number of processes that load data for each device. With 0, a thread loads it."""

    def run(self) -> None:
        """Trains.

        Raises:
            AspEnvError: An option, the data or the folder is bad.
        """
        try:
            from predictors.inference.pretrained import PRETRAINED, pretrained_folder
            from predictors.training.fitting import train, train_stages
            from predictors.training.trainer import Hardware, is_first_process
            from predictors.training.variants import warm_starts_from_3s
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "train", "training") from error

        hardware = Hardware(
            devices=self.devices,
            nodes=self.nodes,
            strategy=self.strategy,
            compiled=self.compile,
            num_workers=self.num_workers,
        )
        start = None if self.start is None else Path(self.start)
        if self.start == PRETRAINED:
            start = pretrained_folder(self.predictor)
        if warm_starts_from_3s(self.predictor, self.variant):
            run = train_stages(
                self.config_for,
                self.horizon,
                self.data,
                self.out,
                start=start,
                hardware=hardware,
            )
        else:
            config = self.config_for(self.horizon)
            run = train(config, self.data, self.out, start=start, hardware=hardware)
        if is_first_process():
            Console().print(f"wrote {run}: name it as {self.predictor}:{run}")

    def config_for(self, horizon_s: float) -> Any:
        """The configuration of a run for a horizon in seconds.

        Raises:
            AspEnvError: A name is unknown, or a number is out of its range.
        """
        from predictors.training.recipes import recipe
        from predictors.training.variants import variant

        config = recipe(self.predictor, self.recipe, view=self.view, horizon_s=horizon_s)
        config = dataclasses.replace(
            config,
            split=self.split,
            seed=self.seed,
            validation=self.validation,
            history=self.history,
            parked=self.parked,
            max_snippets=self.max_snippets,
            epochs=config.epochs if self.epochs is None else self.epochs,
            precision=config.precision if self.precision is None else self.precision,
        )
        if self.variant is not None:
            config = variant(self.predictor, self.variant).apply(config, self.variant)
        return config
