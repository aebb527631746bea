"""The command `asp-env train`."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

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
    recipe: str = "cpu"
    """cpu (the paper's structure in minutes on two cores), ours (better, as small) or paper (the
    paper's network and schedule)."""
    variant: str | None = None
    """The preset with a change by name, such as no-trail: an ablation."""
    view: str = "chauffeurnet"
    """What the network looks at: chauffeurnet, mtp or vectors."""
    horizon: float = 3.0
    """How far it forecasts, seconds. Over 3 s, ssp-asp and the variant staged of the others go on
    from a run for 3 s, in OUT/3s."""
    start: Path | None = None
    """A finished run to start from, or a safetensors file of ResNet18 weights."""
    validation: str | None = None
    """Other data to select on; all of DATA is learned from then."""
    history: Literal["recorded", "causal"] = "recorded"
    """Histories as recorded, or filtered again by a filter that knows no later frame."""
    split: Literal["recording", "blocks"] = "recording"
    """What is held out: whole recordings, or blocks of time within each."""
    epochs: int | None = None
    """Instead of the preset's; of each stage where there are two."""
    seed: int = 0
    """Of the initial weights and the order of the data."""
    max_snippets: int | None = None
    """Learn from no more than so many, chosen at random."""

    precision: Literal["32-true", "bf16-mixed"] | None = None
    """Of the encoder, instead of the preset's; all that follows it is always float32."""
    devices: int | Literal["auto"] = 1
    """Processes on each node, with a GPU each if there are GPUs; auto is one per GPU. They share
    every batch."""
    nodes: int = 1
    """Machines that take part. The same command is started on each, with OUT and DATA in folders
    that all of them see, and with MASTER_ADDR, MASTER_PORT and NODE_RANK set or by torchrun."""
    strategy: Literal["auto", "ddp"] = "auto"
    """How processes work together; ddp takes it also where there is but one."""
    compile: bool = False
    """Compile the encoder with torch.compile: some tens of seconds at first, faster later."""
    num_workers: int = 0
    """Processes that draw batches ahead for each device, where one thread is too slow for a GPU."""

    def run(self) -> None:
        """Trains.

        Raises:
            AspEnvError: an option, the data or the folder is bad.
        """
        try:
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
        if warm_starts_from_3s(self.predictor, self.variant):
            run = train_stages(
                self.config_for,
                self.horizon,
                self.data,
                self.out,
                start=self.start,
                hardware=hardware,
            )
        else:
            config = self.config_for(self.horizon)
            run = train(config, self.data, self.out, start=self.start, hardware=hardware)
        if is_first_process():
            Console().print(f"wrote {run}: name it as {self.predictor}:{run}")

    @staticmethod
    def warm_starts_from_3s(predictor: str, variant: str | None = None) -> bool:
        """Whether a run for more than 3 s goes on from one for 3 s.

        Raises:
            AspEnvError: the predictor has no such variant.
        """
        from predictors.training.variants import warm_starts_from_3s

        return warm_starts_from_3s(predictor, variant)

    @staticmethod
    def variants(predictor: str) -> Mapping[str, Any]:
        """What `variant` can be for a predictor, by name."""
        from predictors.training.variants import VARIANTS

        return VARIANTS.get(predictor, {})

    def config_for(self, horizon_s: float) -> Any:
        """All that decides the weights of a run for a horizon, besides data and start.

        Raises:
            AspEnvError: a name is unknown, or a number out of its range.
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
            max_snippets=self.max_snippets,
            epochs=config.epochs if self.epochs is None else self.epochs,
            precision=config.precision if self.precision is None else self.precision,
        )
        if self.variant is not None:
            config = variant(self.predictor, self.variant).apply(config, self.variant)
        return config
