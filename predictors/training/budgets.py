"""Budgets: what the number of prediction epochs of a run follows from.

Pre-training is additional under every budget, as in Janjoš et al. (2021).

- `epochs`: the prediction epochs of the recipe, which are equal for all predictors.
- `cpu`: equal CPU time. The reference, a recipe of a predictor, sets the time: that of its own
  epochs, pre-training and first stage included. Every other run has as many prediction epochs as
  take the time that is left after its pre-training, at least one. The costs of an epoch are
  measured once and stored in a file (`EpochCosts`); equal files give equal numbers of epochs. The
  time to open the data is not counted.
- `converged`: until the validation error has not improved for a number of prediction epochs
  (`patience`), up to a limit. `one-cycle` ends after a given number of steps, so these runs have
  the schedule `plateau`, from the learning rate of their recipe. The epoch with the lowest
  validation error is the result, as in every run. Annealing and scheduled continuation take as many
  epochs as in the recipe.

A run that starts from a run for 3 s has a budget for each stage; the CPU times of both stages add
up to that of the reference. With segments shorter than 3 s, the run for one segment has half of
the CPU time for 3 s (`SHORT_SEGMENT_SHARE`). The reference has the segments of its recipe.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from asp_env.data.snippets import HISTORY_S
from asp_env.errors import AspEnvError
from asp_env.files import atomic_file
from asp_env.stored import parse_json
from predictors.training.recipes import SEGMENT_S, SHORT_SEGMENT_SHARE, TrainingConfig

COSTS = "epoch_costs.json"
"""File of measured costs in the folder of a run or a table."""

CONVERGED_PATIENCE = 10
"""Prediction epochs without a lower validation error that end a run. Chosen by hand: in that time
`plateau` lowers the learning rate three times, while a run of a recipe `cpu` takes minutes."""

CONVERGED_LIMIT = 10
"""Largest number of prediction epochs of a converged run, in units of the recipe's. Chosen by hand:
it bounds the time of runs whose validation error falls very slowly."""


class EpochCost(NamedTuple):
    """CPU time of one epoch, validation included, in seconds."""

    prediction_s: float
    pretraining_s: float = 0.0
    """0 for a recipe without pre-training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpochCosts:
    """Measured costs of an epoch, stored as JSON."""

    reference: str
    """The reference as PREDICTOR:RECIPE."""
    epochs: Mapping[str, EpochCost] = field(default_factory=dict)
    """The costs by `cost_key`."""

    @classmethod
    def read(cls, path: Path, reference: str) -> "EpochCosts":
        """Reads a file; a missing file holds no costs.

        Args:
            path: The file.
            reference: The expected reference.

        Raises:
            AspEnvError: The file is damaged, or has another reference.
        """
        if not path.exists():
            return cls(reference=reference)
        try:
            content = parse_json(path.read_bytes())
            costs = cls(
                reference=str(content["reference"]),
                epochs={key: EpochCost(**cost) for key, cost in content["epochs"].items()},
            )
        except OSError as error:
            raise AspEnvError(
                f"{path}: cannot be read ({error.strerror}); expected a file of costs, or nothing"
            ) from error
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise AspEnvError(
                f"{path}: holds no costs of epochs ({error}); delete it to measure them again"
            ) from error
        if costs.reference != reference:
            raise AspEnvError(
                f"{path}: holds costs with the reference {costs.reference}, not {reference}; give "
                "that one as --cpu-reference, or another --costs"
            )
        return costs

    def write(self, path: Path) -> None:
        """Writes the file atomically."""
        epochs = {key: cost._asdict() for key, cost in sorted(self.epochs.items())}
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as partial:
            partial.write_text(
                json.dumps({"reference": self.reference, "epochs": epochs}, indent=1) + "\n"
            )

    def of(self, config: TrainingConfig) -> EpochCost:
        """The cost of an epoch of a configuration.

        Raises:
            AspEnvError: It was not measured.
        """
        key = cost_key(config)
        if key not in self.epochs:
            raise AspEnvError(
                f"the CPU time of an epoch of {key} is not measured: run the command without "
                "--jobs 0, or give --costs"
            )
        return self.epochs[key]


class Model(NamedTuple):
    """A predictor with a recipe and options, for any horizon."""

    config_for: Callable[[float], TrainingConfig]
    """Maps a horizon in seconds to the configuration."""
    staged: bool
    """Whether a longer run starts from a run for one segment, or for 3 s."""

    def stages(self, horizon_s: float) -> list[TrainingConfig]:
        """The runs that a forecast for a horizon takes, in order."""
        config = self.config_for(horizon_s)
        if not self.staged or horizon_s <= config.first_stage_s:
            return [config]
        return [self.config_for(config.first_stage_s), config]


def cost_key(config: TrainingConfig) -> str:
    """The name of a configuration in a file of costs.

    It has the recipe with the variant, the view and the horizon, the length of the segments and of
    the history and the precision where they are not the default, whether parked vehicles are
    targets, too, and the limit of the number of snippets.
    """
    parts = [f"{config.predictor}:{config.preset}", config.view, f"{config.horizon_s:g}s"]
    if config.segment_s not in (None, SEGMENT_S):
        parts.append(f"segments-{config.segment_s:g}s")
    if config.history_s != HISTORY_S:
        parts.append(f"history-{config.history_s:g}s")
    if config.parked:
        parts.append("parked")
    if config.precision != "32-true":
        parts.append(config.precision)
    if config.max_snippets is not None:
        parts.append(f"{config.max_snippets}-snippets")
    return "/".join(parts)


def until_converged(
    config: TrainingConfig, *, limit: int | None = None, patience: int | None = None
) -> TrainingConfig:
    """A configuration that trains until the validation error stops to improve.

    Args:
        config: The recipe.
        limit: Largest number of prediction epochs; None for `CONVERGED_LIMIT` times the recipe's.
        patience: Prediction epochs without a lower validation error that end the run; None for
            `CONVERGED_PATIENCE`.
    """
    limit = CONVERGED_LIMIT * config.epochs if limit is None else limit
    return dataclasses.replace(
        config,
        budget="converged",
        schedule="plateau",
        epochs=limit,
        patience=CONVERGED_PATIENCE if patience is None else patience,
        progress_epochs=min(config.epochs, limit),
    )


def in_cpu_time(
    model: Model, horizon_s: float, *, reference: Model, costs: EpochCosts
) -> TrainingConfig:
    """A configuration whose run takes the CPU time of the reference for the same horizon.

    Args:
        model: The predictor that is trained.
        horizon_s: Horizon, seconds. The first stage of a staged model has a budget of its own: that
            of the reference for the same horizon or, for a segment shorter than 3 s, half of that
            for 3 s.
        reference: The reference.
        costs: Measured costs of an epoch.

    Raises:
        AspEnvError: A cost was not measured.
    """
    *first, config = model.stages(horizon_s)
    time_s = _reference_time_s(reference, config, costs)
    time_s -= sum(_reference_time_s(reference, each, costs) for each in first)
    cost = costs.of(config)
    time_s -= config.pretraining_epochs * cost.pretraining_s
    return dataclasses.replace(
        config, budget="cpu", epochs=max(1, round(time_s / cost.prediction_s))
    )


def _reference_time_s(reference: Model, config: TrainingConfig, costs: EpochCosts) -> float:
    """CPU time of the reference for a run and its first stage, seconds."""
    share = SHORT_SEGMENT_SHARE if _is_short_segment(config) else 1.0
    return share * cpu_time_s(_reference_stages(reference, config), costs)


def _reference_stages(reference: Model, config: TrainingConfig) -> list[TrainingConfig]:
    """The runs of the reference that set the budget of a run and its first stage."""
    return reference.stages(SEGMENT_S if _is_short_segment(config) else config.horizon_s)


def _is_short_segment(config: TrainingConfig) -> bool:
    """Whether a run is for one segment that is shorter than 3 s."""
    return config.horizon_s == config.segment_s and config.horizon_s < SEGMENT_S


def cpu_time_s(stages: Sequence[TrainingConfig], costs: EpochCosts) -> float:
    """CPU time of all epochs of some runs, seconds.

    Raises:
        AspEnvError: A cost was not measured.
    """
    return sum(
        each.pretraining_epochs * costs.of(each).pretraining_s
        + each.epochs * costs.of(each).prediction_s
        for each in stages
    )


def needed_configs(model: Model, horizon_s: float, reference: Model) -> list[TrainingConfig]:
    """The configurations whose costs the budget `cpu` of a model needs, each once."""
    stages = model.stages(horizon_s)
    configs = [each for stage in stages for each in _reference_stages(reference, stage)]
    return list({cost_key(each): each for each in (*configs, *stages)}.values())


def complete_costs(
    path: Path,
    reference: str,
    configs: Sequence[TrainingConfig],
    measure: Callable[[Sequence[TrainingConfig]], Sequence[EpochCost]],
) -> EpochCosts:
    """Measures the costs that a file lacks, and adds them to it.

    Known costs stay as they are. The reference is measured beside new costs of the same view, and
    these are scaled by the ratio of its known cost to its present one, so that costs of
    different days and machines are comparable.

    Args:
        path: The file.
        reference: The reference as PREDICTOR:RECIPE.
        configs: The configurations whose costs are needed.
        measure: Measures the costs of configurations side by side.

    Raises:
        AspEnvError: The file is damaged, or has another reference.
    """
    costs = EpochCosts.read(path, reference)
    by_key = {cost_key(each): each for each in configs}
    missing = [key for key in by_key if key not in costs.epochs]
    if not missing:
        return costs
    known = [key for key in by_key if key not in missing and key.startswith(f"{reference}/")]
    measured = dict(
        zip(
            [*missing, *known],
            measure([by_key[key] for key in (*missing, *known)]),
            strict=True,
        )
    )
    scale = {
        by_key[key].view: costs.epochs[key].prediction_s / measured[key].prediction_s
        for key in known
    }
    added = {
        key: EpochCost(*(scale.get(by_key[key].view, 1.0) * each for each in measured[key]))
        for key in missing
    }
    completed = dataclasses.replace(costs, epochs={**costs.epochs, **added})
    completed.write(path)
    return completed
