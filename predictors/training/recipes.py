"""Recipes: how each predictor is trained, as functions that return a whole configuration.

Each recipe takes a view and a horizon in seconds. Its docstring gives its command; variants
(`predictors.training.variants`) change fields of a recipe.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from asp_env.arguments import MAX_SEED
from asp_env.data.histories import History
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.snippets import HISTORY_S
from asp_env.data.split import Split
from asp_env.errors import AspEnvError, unknown_name
from asp_env.views import RasterView, make_view
from predictors.models.chaining import segment_ticks
from predictors.models.dkm import DKMConfig
from predictors.models.ffw_asp import FFWASPConfig
from predictors.models.mtp import MTPConfig
from predictors.models.network import NetworkConfig
from predictors.models.ssp_asp import SSPASPConfig
from predictors.training.augmentation import Augmentation

Budget = Literal["epochs", "cpu", "converged"]
"""What the prediction epochs of a run follow from: its recipe, equal CPU time, or convergence."""

SEGMENT_S = 3.0
"""Length of the segments that `ssp-asp` chains by default, seconds: the paper's shorter horizon."""

SHORT_SEGMENT_SHARE = 0.5
"""Share of the budget of a run for 3 s that a run for one shorter segment has; the rest is that of
the run for 3 s, which starts from it. Chosen by hand: both learn the same, over fewer or more
ticks."""

CHAINED = frozenset({"ssp-asp"})
"""Predictors whose runs for longer horizons start from the weights of a run for one segment, as in
the paper; the others predict every horizon at once and are trained on it from the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """Everything that decides the weights, besides the content of the data.

    The names of the fields are keys of `config.json`.
    """

    predictor: str
    preset: str
    """Name of the recipe."""
    network: NetworkConfig
    view: str
    pixels: tuple[int, int] | None
    """Height and width of rasters; None for the view's own, or for a view without rasters."""
    horizon_s: float
    dt_s: float = DEFAULT_DT_S
    split: Split = "recording"
    validation: tuple[str, ...] = ()
    """Separate validation data; all of DATA is trained on if there are any."""
    history: History = "recorded"
    """Whether inputs show the histories as recorded, smoothed with later frames, or filtered
    forward, or with recorded accelerations."""
    history_s: float = HISTORY_S
    """Length of the past that inputs show, in actions and in the view (`mtp` shows at most 2 s)."""
    parked: bool = False
    """Whether parked vehicles are targets, too."""
    seed: int = 0
    max_snippets: int | None = None
    """Largest number of training snippets, chosen at random; None for all."""
    max_validation_snippets: int | None = None
    standing_share: float = 1.0
    """Largest share of standing targets in the training snippets."""
    epochs: int = 10
    """Prediction epochs: those after the pre-training; their largest number with `patience`."""
    pretraining_epochs: int = 0
    """Epochs before the prediction epochs, in which `ssp-asp` learns its features only."""
    budget: Budget = "epochs"
    """What the number of prediction epochs follows from, see `predictors.training.budgets`."""
    patience: int | None = None
    """Prediction epochs without a lower validation error after which the training ends; None for
    all epochs."""
    progress_epochs: int | None = None
    """Prediction epochs after which the annealing of modes and the scheduled continuation of
    segments are complete; None for all."""
    snippets_per_epoch: int | None = None
    """Largest number of snippets in an epoch, which bounds the time of a run on much data; None for
    all."""
    batch_size: int = 32
    learning_rate: float = 1e-4
    weight_decay: float = 0.0
    schedule: Literal["plateau", "one-cycle"] = "plateau"
    """`plateau` divides the learning rate by 5 after 3 epochs without improvement; `one-cycle`
    raises it over the first tenth of all steps and lowers it along a cosine to zero."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """Precision of the encoder; the rest of the network is always float32."""
    threads: int | None = None
    """Threads of torch within one operation; None for its default."""
    augmentation: Augmentation | None = None
    """Random changes of the samples, in training and in validation; None for none."""

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            AspEnvError: A number is out of its range.
        """
        for field in (
            "epochs",
            "patience",
            "progress_epochs",
            "batch_size",
            "snippets_per_epoch",
            "max_snippets",
            "max_validation_snippets",
            "threads",
        ):
            value = getattr(self, field)
            if value is not None and value < 1:
                raise AspEnvError(f"training: {field} is {value}, expected 1 or more")
        if not 0 <= self.seed <= MAX_SEED:
            raise AspEnvError(f"training: seed is {self.seed}, expected 0 to {MAX_SEED}")
        if self.pretraining_epochs < 0:
            raise AspEnvError(
                f"training: pretraining_epochs is {self.pretraining_epochs}, expected 0 or more"
            )
        if self.patience is not None and self.schedule != "plateau":
            raise AspEnvError(
                f"training: patience is {self.patience} with the schedule {self.schedule}, which "
                "ends after a given number of steps: expected the schedule plateau"
            )
        if self.augmentation is not None and self.history == "accelerations":
            raise AspEnvError(
                "training: augmentation infers past actions from changed states, the history "
                "accelerations takes them from the files: expected another history or recipe"
            )
        if not 0 < self.standing_share <= 1:
            raise AspEnvError(
                f"training: standing_share is {self.standing_share}, expected within (0, 1]"
            )

    @property
    def segment_s(self) -> float | None:
        """Length of the segments that are chained, seconds; None if the horizon is one forecast."""
        return self.network.segment_s if isinstance(self.network, SSPASPConfig) else None

    @property
    def first_stage_s(self) -> float:
        """Horizon of the run that a run in two stages starts from: one segment, or 3 s."""
        return SEGMENT_S if self.segment_s is None else self.segment_s

    @property
    def all_epochs(self) -> int:
        """Number of epochs of the run: pre-training and prediction epochs."""
        return self.pretraining_epochs + self.epochs


def mtp_paper(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train mtp DATA --recipe paper`: MTP with the encoder and schedule of the paper."""
    return _paper("mtp", MTPConfig(), view, horizon_s)


def mtp_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train mtp DATA`: MTP at small size, see `_small`."""
    return _small("mtp", "cpu", MTPConfig(hidden=256), view, horizon_s)


def dkm_paper(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train dkm DATA --recipe paper`: DKM with the encoder and schedule of the paper."""
    return _paper("dkm", DKMConfig(), view, horizon_s)


def dkm_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train dkm DATA`: DKM at small size, see `_small`, integrated by Heun's method."""
    return _small("dkm", "cpu", DKMConfig(hidden=256, integrator="heun"), view, horizon_s)


def ffw_asp_paper(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train ffw-asp DATA --recipe paper`: the paper's FFW-ASP, also at 6 s."""
    return _paper("ffw-asp", FFWASPConfig(), view, horizon_s)


def ffw_asp_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train ffw-asp DATA`: FFW-ASP at small size, see `_small`, by Heun's method."""
    network = FFWASPConfig(gru_width=128, integrator="heun")
    return _small("ffw-asp", "cpu", network, view, horizon_s)


def ffw_asp_ours(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train ffw-asp DATA --recipe ours`: small size, improved by the ablations.

    Differs from `cpu`: features, speed and past actions skip the GRU, which has one layer
    and is followed by a hidden layer; modes are assigned by distance; more standing targets,
    longer epochs and a higher learning rate. Chosen on validation data of synthetic traffic
    (`docs/results.md`).
    """
    network = FFWASPConfig(
        gru_width=128, gru_layers=1, skip=True, hidden=256, integrator="heun", assignment="distance"
    )
    config = _small("ffw-asp", "ours", network, view, horizon_s)
    return dataclasses.replace(
        config, standing_share=0.5, snippets_per_epoch=15_000, learning_rate=4e-3
    )


def ffw_asp_robust(view: str, horizon_s: float) -> TrainingConfig:
    """`asp-env train ffw-asp DATA --recipe robust`: `ours` for traffic that it is not trained on.

    See `_robust`.

    Raises:
        AspEnvError: The view renders rasters.
    """
    return _robust(ffw_asp_ours(view, horizon_s))


def ssp_asp_paper(view: str, horizon_s: float, segment_s: float = SEGMENT_S) -> TrainingConfig:
    """`asp-env train ssp-asp DATA --recipe paper`: the paper's SSP-ASP.

    Three epochs of pre-training come before the ten of the paper. A run for more than one segment
    (3 s) starts from one for one segment, without pre-training.

    Raises:
        AspEnvError: The horizon is not a whole number of segments, or a segment not one of ticks.
    """
    segment_ticks(segment_s, horizon_s=horizon_s, dt_s=DEFAULT_DT_S)
    config = _paper("ssp-asp", SSPASPConfig(segment_s=segment_s), view, horizon_s)
    return _with_pretraining(config, horizon_s, 3)


def ssp_asp_cpu(view: str, horizon_s: float, segment_s: float = SEGMENT_S) -> TrainingConfig:
    """`asp-env train ssp-asp DATA`: SSP-ASP at small size, see `_small`, by Heun's method.

    Two epochs of pre-training come before the eight prediction epochs, as in the paper, where they
    are additional.

    Raises:
        AspEnvError: The horizon is not a whole number of segments, or a segment not one of ticks.
    """
    segment_ticks(segment_s, horizon_s=horizon_s, dt_s=DEFAULT_DT_S)
    network = SSPASPConfig(segment_s=segment_s, gru_width=128, integrator="heun")
    config = _small("ssp-asp", "cpu", network, view, horizon_s)
    return _with_pretraining(config, horizon_s, 2)


def ssp_asp_ours(view: str, horizon_s: float, segment_s: float = SEGMENT_S) -> TrainingConfig:
    """`asp-env train ssp-asp DATA --recipe ours`: small size, improved by the ablations.

    Differs from `cpu`: no pre-training; features, speed and past actions skip the GRU, which has
    one layer and is followed by a hidden layer; features are normalised and fixed as targets; modes
    are assigned by distance and annealed in the run for one segment, which keeps them apart, and a
    longer run starts from those; later segments follow the most probable mode ever more often;
    forecasts are merged into three modes. Chosen on validation data of synthetic traffic
    (`docs/results.md`).

    Raises:
        AspEnvError: The horizon is not a whole number of segments, or a segment not one of ticks.
    """
    segment_ticks(segment_s, horizon_s=horizon_s, dt_s=DEFAULT_DT_S)
    network = SSPASPConfig(
        segment_s=segment_s,
        gru_width=128,
        gru_layers=1,
        skip=True,
        hidden=256,
        integrator="heun",
        assignment="distance",
        annealed=horizon_s <= segment_s,
        kept=3,
        spread_mps=0.8,
        normalise=True,
        stop_gradient=True,
        scheduled=True,
    )
    return _small("ssp-asp", "ours", network, view, horizon_s)


def ssp_asp_robust(view: str, horizon_s: float, segment_s: float = SEGMENT_S) -> TrainingConfig:
    """`asp-env train ssp-asp DATA --recipe robust`: `ours` for traffic that it is not trained on.

    See `_robust`.

    Raises:
        AspEnvError: The view renders rasters, the horizon is not a whole number of segments, or a
            segment not one of ticks.
    """
    return _robust(ssp_asp_ours(view, horizon_s, segment_s))


Recipe = Callable[..., TrainingConfig]
"""Makes a configuration of a view and a horizon in seconds and, for the predictors of `CHAINED`,
the length of a segment in seconds."""

RECIPES: Mapping[str, Mapping[str, Recipe]] = MappingProxyType(
    {
        "mtp": {"cpu": mtp_cpu, "paper": mtp_paper},
        "dkm": {"cpu": dkm_cpu, "paper": dkm_paper},
        "ffw-asp": {
            "cpu": ffw_asp_cpu,
            "paper": ffw_asp_paper,
            "ours": ffw_asp_ours,
            "robust": ffw_asp_robust,
        },
        "ssp-asp": {
            "cpu": ssp_asp_cpu,
            "paper": ssp_asp_paper,
            "ours": ssp_asp_ours,
            "robust": ssp_asp_robust,
        },
    }
)
"""Recipes by predictor and name."""


def recipe(
    predictor: str,
    name: str,
    *,
    view: str,
    horizon_s: float,
    segment_s: float | None = None,
    history_s: float = HISTORY_S,
) -> TrainingConfig:
    """Makes the configuration of a recipe.

    Args:
        predictor: Name of the predictor.
        name: Name of the recipe.
        view: Name of the view.
        horizon_s: Horizon, seconds.
        segment_s: Length of the segments that are chained, seconds; None for the default. Only for
            the predictors of `CHAINED`.
        history_s: Length of the past that inputs show, seconds.

    Raises:
        AspEnvError: A name is unknown (known ones are listed), the horizon is no whole number of
            segments, the predictor chains no segments, or a duration is no whole number of ticks.
    """
    if predictor not in RECIPES:
        raise unknown_name("trainable predictor", predictor, RECIPES)
    recipes = RECIPES[predictor]
    if name not in recipes:
        raise unknown_name(f"recipe of {predictor}", name, recipes)
    ticks(history_s, DEFAULT_DT_S)
    if predictor in CHAINED:
        config = recipes[name](view, horizon_s, SEGMENT_S if segment_s is None else segment_s)
    elif segment_s is None:
        config = recipes[name](view, horizon_s)
    else:
        raise AspEnvError(
            f"segments of {segment_s:g} s: {predictor} forecasts the whole horizon at once, only "
            f"{', '.join(sorted(CHAINED))} chains segments; leave their length out"
        )
    return dataclasses.replace(config, history_s=history_s)


def _paper(predictor: str, network: NetworkConfig, view: str, horizon_s: float) -> TrainingConfig:
    """The paper's size and schedule: Adam at 1e-4, batches of 32, 10 epochs, `plateau`."""
    if not isinstance(make_view(view), RasterView):
        network = dataclasses.replace(network, encoder="vector")
    return TrainingConfig(
        predictor=predictor,
        preset="paper",
        network=network,
        view=view,
        pixels=None,
        horizon_s=horizon_s,
    )


def _small(
    predictor: str, name: str, network: NetworkConfig, view: str, horizon_s: float
) -> TrainingConfig:
    """Small size, for minutes on two cores; the numbers are chosen by hand.

    Rasters have a quarter of the resolution, the encoder is small, and the schedule is
    `one-cycle`. A longer horizon takes as many prediction epochs again: after those for 3 s if
    segments are chained, else at once.
    """
    at_once = horizon_s > SEGMENT_S and predictor not in CHAINED
    drawn = make_view(view)
    vectors = not isinstance(drawn, RasterView)
    pixels = None if vectors else (drawn.shape[1] // 4, drawn.shape[2] // 4)
    network = dataclasses.replace(network, encoder="vector" if vectors else "small", features=256)
    return TrainingConfig(
        predictor=predictor,
        preset=name,
        network=network,
        view=view,
        pixels=pixels,
        horizon_s=horizon_s,
        standing_share=0.25,
        epochs=16 if at_once else 8,
        snippets_per_epoch=6_000,
        max_validation_snippets=2_000,
        batch_size=64,
        learning_rate=1e-3,
        weight_decay=1e-2,
        schedule="one-cycle",
        precision="32-true" if vectors else "bf16-mixed",
        threads=1,
    )


def _robust(config: TrainingConfig) -> TrainingConfig:
    """Augmented samples, a standing mode with more standing targets, and shrunk accelerations.

    Give validation data of other traffic than the training data: the epoch, the probabilities and
    the factor of the accelerations are chosen on them.

    Raises:
        AspEnvError: The view renders rasters.
    """
    if config.network.encoder != "vector":
        raise AspEnvError(
            f"recipe robust augments vectors, the view {config.view} renders rasters: give "
            "--view vectors"
        )
    return dataclasses.replace(
        config,
        preset="robust",
        network=dataclasses.replace(config.network, annealed=True, standing=True, shrunk=True),
        standing_share=0.5,
        snippets_per_epoch=6_000,
        learning_rate=min(config.learning_rate, 2e-3),
        augmentation=Augmentation(),
    )


def _with_pretraining(config: TrainingConfig, horizon_s: float, epochs: int) -> TrainingConfig:
    """Adds epochs of pre-training, unless the run starts from one that had them."""
    if horizon_s > config.first_stage_s:
        return config
    return dataclasses.replace(config, pretraining_epochs=epochs)
