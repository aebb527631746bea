"""The command `asp-env train`; importing it needs neither torch nor Lightning."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from asp_env.errors import AspEnvError, MissingExtraError

DEFAULT_RECIPE, DEFAULT_VIEW, DEFAULT_HORIZON_S = "cpu", "chauffeurnet", 3.0

RUN_DECIDES: dict[str, Any] = {
    **dict.fromkeys(("view", "recipe", "variant", "horizon", "history", "start", "precision")),
    **{"devices": 1, "nodes": 1, "strategy": "auto", "compile": False, "num_workers": 0},
}
"""Options that cannot be given with `--from`, and their defaults."""


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
    from_run: Annotated[str | None, tyro.conf.arg(name="from", metavar="NAME:RUN")] = None
    """Fine-tune a finished run, such as ssp-asp:pretrained: at a
    low learning rate, until the validation error no longer
    falls. View, recipe, horizon and histories are the run's."""
    mix: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """With --from: other data, which half of each batch is taken
    from, so that the network does not forget them."""
    recipe: str | None = None
    """Recipe: cpu (the default; the paper's structure, minutes
    on two cores), ours (more accurate at the same size) or
    paper (the paper's size and schedule)."""
    variant: str | None = None
    """Variant of the recipe by name, such as no-trail, for ablations."""
    view: str | None = None
    """View that the network observes: chauffeurnet (the
    default), mtp or vectors."""
    horizon: float | None = None
    """Horizon of the forecasts in seconds, by default 3. Above 3 s, ssp-asp
    and the variant staged of the others start from a run for
    3 s in OUT/3s."""
    start: str | None = None
    """What to start from: a finished run, pretrained (the
    weights that ship with this package), or a safetensors
    file of ResNet18 weights."""
    validation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """Separate validation data. All of DATA is then used for training."""
    history: Literal["recorded", "causal"] | None = None
    """Histories that the network observes: recorded (the
    default; smoothed with later frames), or causal (filtered
    again without later frames)."""
    split: Literal["recording", "blocks"] | None = None
    """What is held out: whole recordings (the default), or blocks
    of time within each; with --from, blocks if there are too
    few recordings."""
    epochs: int | None = None
    """Number of epochs instead of the recipe's; with two stages,
    the number for each; with --from, the largest number."""
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
        if self.from_run is not None:
            self._fine_tune(self.from_run)
            return
        if self.mix:
            raise AspEnvError("--mix: only a fine-tuning mixes data; give --from NAME:RUN as well")
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
                self.horizon or DEFAULT_HORIZON_S,
                self.data,
                self.out,
                start=start,
                hardware=hardware,
            )
        else:
            config = self.config_for(self.horizon or DEFAULT_HORIZON_S)
            run = train(config, self.data, self.out, start=start, hardware=hardware)
        if is_first_process():
            Console().print(f"wrote {run}: name it as {self.predictor}:{run}")

    def _fine_tune(self, name: str) -> None:
        """Fine-tunes a run.

        Raises:
            AspEnvError: The name or an option are bad, or the data or the folder.
        """
        given = [
            f"--{option.replace('_', '-')}"
            for option, default in RUN_DECIDES.items()
            if getattr(self, option) != default
        ]
        if given:
            raise AspEnvError(
                f"{' '.join(given)} with --from {name}: a fine-tuning takes view, recipe, horizon "
                "and histories from the run, and runs on one device; leave it out"
            )
        kind, _, argument = name.partition(":")
        if kind != self.predictor or not argument:
            raise AspEnvError(
                f"--from {name}: expected a finished run of {self.predictor}, such as "
                f"{self.predictor}:RUN"
            )
        try:
            from predictors.inference.checkpoint import folder_and_chaining
            from predictors.training.fine_tuning import EPOCHS, FineTuning, fine_tune
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "train", "training") from error
        start, _ = folder_and_chaining(kind, argument)
        options = FineTuning(
            split=self.split,
            validation=self.validation,
            mix=self.mix,
            epochs=EPOCHS if self.epochs is None else self.epochs,
            seed=self.seed,
            max_snippets=self.max_snippets,
        )
        run = fine_tune(self.predictor, start, self.data, self.out, options)
        Console().print(f"wrote {run}: name it as {self.predictor}:{run}")

    def config_for(self, horizon_s: float) -> Any:
        """The configuration of a run for a horizon in seconds.

        Raises:
            AspEnvError: A name is unknown, or a number is out of its range.
        """
        from predictors.training.recipes import recipe
        from predictors.training.variants import variant

        config = recipe(
            self.predictor,
            self.recipe or DEFAULT_RECIPE,
            view=self.view or DEFAULT_VIEW,
            horizon_s=horizon_s,
        )
        config = dataclasses.replace(
            config,
            split=self.split or config.split,
            seed=self.seed,
            validation=self.validation,
            history=self.history or config.history,
            max_snippets=self.max_snippets,
            epochs=config.epochs if self.epochs is None else self.epochs,
            precision=config.precision if self.precision is None else self.precision,
        )
        if self.variant is not None:
            config = variant(self.predictor, self.variant).apply(config, self.variant)
        return config
