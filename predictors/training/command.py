"""The command `asp-env train`; importing it needs neither torch nor Lightning."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from asp_env.console import text_console
from asp_env.data.histories import History
from asp_env.data.snippets import HISTORY_S
from asp_env.data.split import Split
from asp_env.errors import AspEnvError, MissingExtraError

DEFAULT_RECIPE, DEFAULT_VIEW, DEFAULT_HORIZON_S = "cpu", "chauffeurnet", 3.0

RUN_DECIDES: dict[str, Any] = {
    **dict.fromkeys(("view", "recipe", "variant", "horizon", "segment_s", "history", "start")),
    **dict.fromkeys(("precision", "patience", "costs")),
    **{"devices": 1, "nodes": 1, "strategy": "auto", "compile": False, "num_workers": 0},
    **{"history_s": HISTORY_S, "parked": False, "budget": "epochs", "cpu_reference": "ssp-asp"},
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
    default), mtp or vectors, or a view of another package."""
    horizon: float | None = None
    """Horizon of the forecasts in seconds, by default 3. Above
    one segment, ssp-asp starts from a run for one segment, in
    OUT/3s for segments of 3 s, and so does the variant staged
    of the others above 3 s."""
    segment_s: float | None = None
    """Length of the segments that ssp-asp chains, seconds; 3 if
    omitted. The horizon is a whole number of them."""
    history_s: float = HISTORY_S
    """Length of the past that the network observes, seconds."""
    start: str | None = None
    """What to start from: a finished run, pretrained (the
    weights that ship with this package), or a safetensors
    file of ResNet18 weights."""
    validation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """Separate validation data. All of DATA is then used for training."""
    history: History | None = None
    """Histories that the network observes: as recorded (the
    default; smoothed with later frames); filtered again
    without later frames (causal); or as recorded, with the
    accelerations of the files in past actions (accelerations)."""
    split: Split | None = None
    """What is held out: whole recordings (the default), whole
    recordings of other times of day (daytime), or blocks of
    time within each (blocks); with --from, blocks if there are
    too few recordings."""
    parked: bool = False
    """Train on parked vehicles, too."""
    epochs: int | None = None
    """Number of prediction epochs instead of the recipe's;
    pre-training is additional. With two stages, the number
    for each. With --budget cpu it is that of the reference,
    with converged, and with --from, the largest number."""
    budget: Literal["epochs", "cpu", "converged"] = "epochs"
    """What the number of prediction epochs follows from: the
    recipe (epochs); the CPU time of --cpu-reference (cpu); or
    the validation error, until it stops to improve
    (converged, with the schedule plateau)."""
    patience: int | None = None
    """Prediction epochs without a lower validation error that
    end a run with --budget converged; 10 by default."""
    cpu_reference: str = "ssp-asp"
    """Predictor, or PREDICTOR:RECIPE, whose CPU time --budget
    cpu gives to every run for the same horizon."""
    costs: Path | None = None
    """File of the measured CPU time of an epoch, for --budget
    cpu; what it lacks is measured and added. The default is
    OUT/epoch_costs.json."""
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
        self.measure_costs()
        start = None if self.start is None else Path(self.start)
        if self.start == PRETRAINED:
            start = pretrained_folder(self.predictor)
        if warm_starts_from_3s(self.predictor, self.variant):
            run = train_stages(
                self.config_for,
                self.horizon_s,
                self.data,
                self.out,
                start=start,
                hardware=hardware,
            )
        else:
            config = self.config_for(self.horizon_s)
            run = train(config, self.data, self.out, start=start, hardware=hardware)
        if is_first_process():
            text_console().print(f"wrote {run}: name it as {self.predictor}:{run}")

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
        text_console().print(f"wrote {run}: name it as {self.predictor}:{run}")

    def config_for(self, horizon_s: float) -> Any:
        """The configuration of a run for a horizon in seconds.

        Raises:
            AspEnvError: A name is unknown, a number is out of its range, or the costs of the budget
                `cpu` are not measured.
        """
        from predictors.training.budgets import EpochCosts, in_cpu_time, until_converged

        self.check_budget()
        if self.budget == "epochs":
            return self.unlimited_for(horizon_s, epochs=self.epochs)
        if self.budget == "converged":
            config = self.unlimited_for(horizon_s)
            return until_converged(config, limit=self.epochs, patience=self.patience)
        model, reference = self._models()
        costs = EpochCosts.read(self._costs_path, self._reference_name)
        return in_cpu_time(model, horizon_s, reference=reference, costs=costs)

    def unlimited_for(self, horizon_s: float, *, epochs: int | None = None) -> Any:
        """The configuration of a run before the budget sets its number of epochs.

        Args:
            horizon_s: Horizon, seconds.
            epochs: Prediction epochs instead of the recipe's.

        Raises:
            AspEnvError: A name is unknown, or a number is out of its range.
        """
        return self._configured(
            self.predictor,
            self.recipe or DEFAULT_RECIPE,
            self.variant,
            horizon_s,
            epochs,
            segment_s=self.segment_s,
        )

    def measure_costs(self) -> None:
        """Measures the CPU time of an epoch that the budget `cpu` needs and its file lacks.

        Raises:
            AspEnvError: The data or the file are bad, or the run has several processes.
        """
        if self.budget != "cpu":
            return
        if (self.devices, self.nodes, self.strategy) != (1, 1, "auto"):
            raise AspEnvError("training: --budget cpu is for one process: leave --devices out")
        from predictors.training.budgets import complete_costs
        from predictors.training.epoch_costs import measure_epochs
        from predictors.training.fitting import check_folder, first_stage_folder

        first_stage = first_stage_folder(self.unlimited_for(self.horizon_s), self.out)
        check_folder(self.out, first_stage=first_stage)
        complete_costs(
            self._costs_path,
            self._reference_name,
            self.costly_configs(),
            lambda configs: measure_epochs(configs, self.data),
        )

    def costly_configs(self) -> list[Any]:
        """The configurations whose costs of an epoch the budget `cpu` needs.

        Raises:
            AspEnvError: A name is unknown, or a number is out of its range.
        """
        from predictors.training.budgets import needed_configs

        model, reference = self._models()
        return needed_configs(model, self.horizon_s, reference)

    def check_budget(self) -> None:
        """Refuses options that the budget does not read, or that are out of range.

        Raises:
            AspEnvError: There is one.
        """
        if self.patience is not None and self.budget != "converged":
            raise AspEnvError(
                f"training: patience is {self.patience} with the budget {self.budget}: give it "
                "with --budget converged"
            )
        if self.patience is not None and self.patience < 1:
            raise AspEnvError(f"training: patience is {self.patience}, expected 1 or more")
        if self.costs is not None and self.budget != "cpu":
            raise AspEnvError(
                f"training: costs are given with the budget {self.budget}: give --budget cpu"
            )
        if self.variant == "long" and self.budget != "epochs":
            raise AspEnvError(
                f"training: the variant long multiplies the epochs, which the budget {self.budget} "
                "sets: leave one of them out"
            )

    @property
    def horizon_s(self) -> float:
        """Horizon of the forecasts, seconds."""
        return DEFAULT_HORIZON_S if self.horizon is None else self.horizon

    @property
    def _costs_path(self) -> Path:
        from predictors.training.budgets import COSTS

        return self.out / COSTS if self.costs is None else self.costs

    @property
    def _reference(self) -> tuple[str, str]:
        """Predictor and recipe of the reference."""
        predictor, _, recipe = self.cpu_reference.partition(":")
        return predictor, recipe or self.recipe or DEFAULT_RECIPE

    @property
    def _reference_name(self) -> str:
        return ":".join(self._reference)

    def _models(self) -> tuple[Any, Any]:
        """The predictor that is trained, and the reference of the budget `cpu`."""
        from predictors.training.budgets import Model
        from predictors.training.variants import warm_starts_from_3s

        predictor, recipe = self._reference
        return (
            Model(self.unlimited_for, warm_starts_from_3s(self.predictor, self.variant)),
            Model(
                lambda horizon_s: self._configured(predictor, recipe, None, horizon_s, self.epochs),
                warm_starts_from_3s(predictor),
            ),
        )

    def _configured(
        self,
        predictor: str,
        recipe_name: str,
        variant_name: str | None,
        horizon_s: float,
        epochs: int | None,
        *,
        segment_s: float | None = None,
    ) -> Any:
        """A recipe with the options of this command, and a variant."""
        from predictors.training.recipes import recipe
        from predictors.training.variants import variant

        chosen = None if variant_name is None else variant(predictor, variant_name)
        if chosen is not None and chosen.segment_s is not None:
            if segment_s is not None:
                raise AspEnvError(
                    f"variant {variant_name} has segments of {chosen.segment_s:g} s: leave out "
                    f"the other length, {segment_s:g} s"
                )
            segment_s = chosen.segment_s
        config = recipe(
            predictor,
            recipe_name,
            view=self.view or DEFAULT_VIEW,
            horizon_s=horizon_s,
            segment_s=segment_s,
            history_s=self.history_s,
        )
        config = dataclasses.replace(
            config,
            split=self.split or config.split,
            seed=self.seed,
            validation=self.validation,
            history=self.history or config.history,
            parked=self.parked,
            max_snippets=self.max_snippets,
            epochs=config.epochs if epochs is None else epochs,
            precision=config.precision if self.precision is None else self.precision,
        )
        return config if chosen is None else chosen.apply(config, str(variant_name))
