"""Fine-tuning against the share of real training data.

`python -m predictors.experiments.finetuning DATA… --from ssp-asp:pretrained --out OUT`

DATA are divided into folds of recordings (`--folds`; 0 holds out one recording at a time) or of
blocks of time within each recording (`--by blocks`). For each fold, the snippets of the others are
the training data. A share of them is taken as a user with less data would have it: recordings in an
order drawn from the seed, each from its beginning, until the share is reached. The last
`VALIDATION_SHARE` of each recording's taken snippets is for validation. Every run is evaluated on
all snippets of the held-out fold:

- `zero-shot`: the run that is fine-tuned, unchanged, which is also the share 0;
- `fine-tuned`: `predictors.training.fine_tuning` on the share;
- `from scratch`: the same recipe and data with random weights, for as many snippets as the recipe
  has, with its own selection of the epoch;
- `constant-velocity`.

`metrics.csv` has FDE and ADE of the most probable mode and of the best of 3, of moving, standing
and all targets, their ratios to constant velocity, and the differences to zero-shot, all paired by
snippet. Values are means over the seeds. Intervals are 95 %, by the bootstrap over held-out
recordings (blocks with `--by blocks`) and seeds, `asp_env.evaluation.statistics`.

Two recordings of the same traffic, such as those of `taf_bw` and their smoothed copies in
`karlsruhe`, must not both be given: one would be trained on and the other held out.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float, Int
from rich.table import Table

from asp_env import registry
from asp_env.console import table_console
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.snippets import SnippetIndex
from asp_env.data.source import Recordings, join_data, open_readable
from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError
from asp_env.evaluation import statistics
from asp_env.evaluation.open_loop.scoring import score_forecasts
from asp_env.evaluation.results import Row, difference_name, write_manifest, write_metrics
from predictors.inference.checkpoint import CONFIG, PredictorSpec, folder_and_chaining
from predictors.training.data import (
    DatasetSplit,
    TrainingData,
    choose_snippets,
    moving_snippets,
    snippets_of,
)
from predictors.training.fine_tuning import FineTuning, config_from, fine_tune_on
from predictors.training.fitting import train_on
from predictors.training.recipes import TrainingConfig, recipe

BASELINE = "constant-velocity"
ZERO_SHOT, TUNED, SCRATCH = "zero-shot", "fine-tuned", "from scratch"

VALIDATION_SHARE = 0.25
"""Share of the taken snippets that select the epoch. Chosen by hand: with an eighth, a share of
10 % of a small data set leaves a single vehicle."""

SHARES_TRIED = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares that a message about a too small one is chosen from."""

METRICS = ("FDE", "ADE")
SELECTIONS = ("most-probable", "best-of-3")
SUBSETS = ("moving", "standing", "all")

Errors = dict[tuple[str, str], Float[np.ndarray, " n"]]
"""Errors of all snippets by selection and metric."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finetuning:
    """Fine-tune a run on shares of real data; compare it with zero-shot and with training anew."""

    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA …")]
    """Real recordings."""
    out: Path
    """Folder of the runs and of the table. What is finished is not computed again."""
    from_run: Annotated[str, tyro.conf.arg(name="from", metavar="NAME:RUN")] = "ssp-asp:pretrained"
    """Run that is fine-tuned."""
    shares: tuple[float, ...] = (0.0, 0.1, 1.0)
    """Shares of the training folds."""
    seeds: int = 3
    """Number of seeds."""
    folds: int = 5
    """Number of folds; 0 holds out one recording at a time."""
    by: Literal["recordings", "blocks"] = "recordings"
    """What a fold consists of."""
    scratch: bool = True
    """Whether runs are trained from scratch, too."""
    mix: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """Other data that are mixed in."""
    epochs: int | None = None
    """Largest number of epochs of both, for trials."""

    def run(self) -> None:
        """Trains, evaluates, writes the folder and prints the table.

        Raises:
            AspEnvError: An option or the data are bad.
        """
        if self.seeds < 1 or self.folds < 0 or not all(0 <= s <= 1 for s in self.shares):
            raise AspEnvError(
                f"finetuning: seeds {self.seeds}, folds {self.folds}, shares {self.shares}; "
                "expected 1 or more, 0 or more, and shares within [0, 1]"
            )
        study = Study.open(self)
        study.check_shares()
        rows = study.rows()
        write_metrics(self.out, rows)
        write_manifest(
            self.out,
            "finetuning",
            **{key: value for key, value in dataclasses.asdict(self).items() if key != "out"},
            data_hash=study.recordings.data_hash(),
            snippets=len(study.index),
        )
        table_console().print(table_of(rows))


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """The data of a study and the folds of its snippets."""

    options: Finetuning
    predictor: str
    start: Path
    config: TrainingConfig
    """Configuration of a fine-tuning."""
    recordings: Recordings
    index: SnippetIndex
    group: Int[np.ndarray, " n"]
    """Recording or block of each snippet, over which intervals are resampled."""
    fold: Int[np.ndarray, " n"]
    """Fold in which a snippet is held out; -1 for one between two blocks."""

    @classmethod
    def open(cls, options: Finetuning) -> "Study":
        """Opens the data and divides them.

        Raises:
            AspEnvError: The run or the data are bad, or there are fewer than two folds.
        """
        name, _, argument = options.from_run.partition(":")
        if not isinstance(registry.find("predictors", name), PredictorSpec) or not argument:
            raise AspEnvError(f"--from {options.from_run}: expected a finished run, NAME:RUN")
        start, _ = folder_and_chaining(name, argument)
        tuning = FineTuning() if options.epochs is None else FineTuning(epochs=options.epochs)
        config = config_from(name, start, tuning)
        recordings = join_data([open_readable(each, dt_s=config.dt_s) for each in options.data])
        index = snippets_of(recordings, config)
        if options.by == "recordings":
            group = index.recording
            fold = folds_of_recordings(np.bincount(group, minlength=len(recordings)), options.folds)
            fold = fold[group]
        else:
            group, fold = folds_of_blocks(index, options.folds or 5)
        if len(np.unique(fold[fold >= 0])) < 2:
            raise AspEnvError(
                f"{', '.join(options.data)}: a single fold has snippets, expected two or more: "
                "give more recordings, or --by blocks"
            )
        return cls(
            options=options, predictor=name, start=start, config=config, recordings=recordings,
            index=index, group=group, fold=fold,
        )  # fmt: skip

    @property
    def horizon(self) -> int:
        """Ticks of the forecasts."""
        return self.index.horizon_ticks

    def check_shares(self) -> None:
        """Checks that every fold can be trained with every share, before any is trained.

        Raises:
            AspEnvError: A share is too small, with the smallest of `SHARES_TRIED` that is not.
        """
        for share in sorted(set(self.options.shares) - {0.0}):
            problem = self._problem(share)
            if problem is None:
                continue
            larger = (each for each in SHARES_TRIED if each > share)
            enough = next((each for each in larger if self._problem(each) is None), None)
            remedy = (
                "no share of these data is enough: give more of them, or fewer folds"
                if enough is None
                else f"give --shares of at least {enough:g}"
            )
            raise AspEnvError(f"share {share:g}: {problem}; {remedy}")

    def _problem(self, share: float) -> str | None:
        """Why a fold cannot be trained with a share, or None."""
        for seed in range(self.options.seeds):
            for fold in np.unique(self.fold[self.fold >= 0]).tolist():
                taken = self._taken(share, seed, fold)
                training, validation = select_by_time(self.index, taken)
                if not (len(training) and len(validation)):
                    found = f"{len(training)} snippets to train and {len(validation)} to validate"
                    return f"with fold {fold} held out and seed {seed}, {found} on"
                moving = moving_snippets(self.recordings, self.index.select(training))
                if self.config.standing_share < 1 and not moving.any():
                    found = f"none of the {len(training)} snippets to train on moves"
                    return f"with fold {fold} held out and seed {seed}, {found}"
        return None

    def _taken(self, share: float, seed: int, fold: int) -> Int[np.ndarray, " taken"]:
        usable = np.flatnonzero(clear_of(self.index, self.fold, fold))
        return take_share(self.index, usable, share, seed=seed)

    def rows(self) -> list[Row]:
        """Trains and evaluates everything; the rows of the table."""
        rows = np.flatnonzero(self.fold >= 0)
        names = [BASELINE, self.options.from_run]
        fixed, masks = self._errors(names, rows)
        methods: dict[tuple[str, float], list[Errors]] = {
            (BASELINE, 0.0): [fixed[BASELINE]],
            (ZERO_SHOT, 0.0): [fixed[self.options.from_run]],
        }
        for share in sorted(set(self.options.shares) - {0.0}):
            for method in (TUNED, SCRATCH) if self.options.scratch else (TUNED,):
                seeds = range(self.options.seeds)
                methods[method, share] = [self._of_seed(method, share, s, rows) for s in seeds]
        return make_rows(
            methods, masks, self.group[rows], data=", ".join(self.options.data),
            horizon_s=self.config.horizon_s, start=self.options.from_run,
        )  # fmt: skip

    def _of_seed(self, method: str, share: float, seed: int, rows: np.ndarray) -> Errors:
        """Errors of the runs of all folds, each on its held-out snippets."""
        joined: Errors = {}
        for fold in np.unique(self.fold[rows]).tolist():
            run = self._train(method, share, seed, fold)
            held_out = np.flatnonzero(self.fold == fold)
            name = f"{self.predictor}:{run}"
            errors, _ = self._errors([name], held_out)
            for key, values in errors[name].items():
                whole = joined.setdefault(key, np.zeros(len(self.fold)))
                whole[held_out] = values
        return {key: values[rows] for key, values in joined.items()}

    def _train(self, method: str, share: float, seed: int, fold: int) -> Path:
        kind = method.replace(" ", "-")
        out = self.options.out / "runs" / kind / f"{share:g}" / f"fold{fold}-seed{seed}"
        if (out / CONFIG).exists():
            return out
        sys.stderr.write(f"{method}, share {share:g}, fold {fold}, seed {seed}\n")
        config = dataclasses.replace(self.config, seed=seed)
        data = self._data(share, seed, fold, config)
        out.parent.mkdir(parents=True, exist_ok=True)
        if method == TUNED:
            return fine_tune_on(
                self.predictor, self.start, data, out, config=config, mix=self.options.mix
            )
        scratch = scratch_config(config, len(data.training.snippets))
        if self.options.epochs is not None:
            scratch = dataclasses.replace(scratch, epochs=self.options.epochs, pretraining_epochs=0)
        return train_on(scratch, data, out)

    def _data(self, share: float, seed: int, fold: int, config: TrainingConfig) -> TrainingData:
        """Training and validation snippets of a share of the other folds."""
        taken = self._taken(share, seed, fold)
        training, validation = select_by_time(self.index, taken)
        chosen = choose_snippets(
            self.recordings,
            self.index.select(training),
            standing_share=config.standing_share,
            max_snippets=None,
            seed=seed,
        )
        hashes = self.recordings.hashes()
        seen = set(self.index.recording[taken].tolist())
        return TrainingData(
            training=DatasetSplit(recordings=self.recordings, snippets=chosen),
            validation=DatasetSplit(
                recordings=self.recordings, snippets=self.index.select(validation)
            ),
            trained_on=TrainedOn(
                source=self.recordings.source,
                split="recording",
                parts={h: "train" if n in seen else "test" for n, h in enumerate(hashes)},
            ),
            data_hash=self.recordings.data_hash(),
            validation_hash=None,
            resampled=self.recordings.resampled(),
        )

    def _errors(
        self, names: Sequence[str], rows: np.ndarray
    ) -> tuple[dict[str, Errors], dict[str, np.ndarray]]:
        """Errors of predictors on some snippets, and the masks of the subsets."""
        predictors: dict[str, Predictor] = {
            name: load_predictor(name, horizon=self.horizon, dt_s=self.index.dt_s) for name in names
        }
        scenes = DatasetSplit(recordings=self.recordings, snippets=self.index).histories(
            self.config
        )
        scores = score_forecasts(
            predictors, self.index.select(rows), scenes=scenes, recorded=self.recordings
        )
        errors = {
            name: {
                (selection, metric): scores.of(name, metric, selection).values.astype(np.float64)
                for selection in SELECTIONS
                for metric in METRICS
            }
            for name in names
        }
        return errors, {name: scores.subsets[name] for name in SUBSETS}


def folds_of_recordings(
    counts: Int[np.ndarray, " recordings"], folds: int
) -> Int[np.ndarray, " recordings"]:
    """The fold of each recording: the largest first, each to the fold with the fewest snippets.

    Args:
        counts: number of snippets of each recording.
        folds: number of folds; 0 for one per recording.
    """
    if not folds or folds >= len(counts):
        return np.arange(len(counts))
    sizes, fold = np.zeros(folds), np.zeros(len(counts), dtype=np.int64)
    for recording in np.argsort(-counts, kind="stable"):
        fold[recording] = sizes.argmin()
        sizes[fold[recording]] += counts[recording]
    return fold


def folds_of_blocks(
    index: SnippetIndex, folds: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Block and fold of each snippet: equal blocks of time within each recording.

    Args:
        index: the snippets.
        folds: number of blocks of a recording; the k-th blocks are fold k.

    Returns:
        The number of the block, and the fold; -1 for a snippet that is not within one block.
    """
    first, last = index.tick - index.history, index.tick + index.horizon_ticks
    ends = np.zeros(int(index.recording.max(initial=0)) + 1, dtype=np.int64)
    np.maximum.at(ends, index.recording, last + 1)
    block, end_block = (ticks * folds // ends[index.recording] for ticks in (first, last))
    fold = np.where(block == end_block, block, -1)
    return index.recording * folds + block, fold


def clear_of(index: SnippetIndex, fold: Int[np.ndarray, " n"], held_out: int) -> np.ndarray:
    """Mask of the snippets that share no tick of a recording with a held-out one."""
    first, last = index.tick - index.history, index.tick + index.horizon_ticks
    clear = fold != held_out
    for recording in np.unique(index.recording[fold == held_out]):
        rows = (index.recording == recording) & (fold == held_out)
        begin, end = first[rows].min(), last[rows].max()
        here = index.recording == recording
        clear &= ~(here & (first <= end) & (last >= begin))
    return clear


def take_share(
    index: SnippetIndex, rows: Int[np.ndarray, " m"], share: float, *, seed: int
) -> Int[np.ndarray, " taken"]:
    """A share of some snippets: recordings in random order, each from its beginning.

    Args:
        index: the snippets.
        rows: rows to take from.
        share: share of them, rounded up.
        seed: seed of the order.
    """
    recordings = np.unique(index.recording[rows])
    place = np.zeros(int(recordings.max(initial=0)) + 1, dtype=np.int64)
    place[np.random.default_rng(seed).permutation(recordings)] = np.arange(len(recordings))
    order = np.lexsort((index.tick[rows], place[index.recording[rows]]))
    return np.sort(rows[order[: int(np.ceil(share * len(rows)))]])


def select_by_time(
    index: SnippetIndex, rows: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " train"], Int[np.ndarray, " validation"]]:
    """Training and validation rows: of each recording, the last snippets validate.

    Snippets between both, whose future reaches beyond the first validation tick, are left out.
    """
    training, validation = [rows[:0]], [rows[:0]]
    for recording in np.unique(index.recording[rows]):
        here = rows[index.recording[rows] == recording]
        ticks = index.tick[here]
        border = np.quantile(ticks, 1 - VALIDATION_SHARE, method="higher")
        validation.append(here[ticks >= border])
        training.append(here[ticks + index.horizon_ticks < border])
    return np.sort(np.concatenate(training)), np.sort(np.concatenate(validation))


def scratch_config(config: TrainingConfig, count: int) -> TrainingConfig:
    """The recipe of a fine-tuned run, with as many snippets in total on less data.

    Args:
        config: configuration of a fine-tuning.
        count: number of training snippets.
    """
    name = config.preset.partition("+")[0]
    base = recipe(config.predictor, name, view=config.view, horizon_s=config.horizon_s)
    per_epoch = min(base.snippets_per_epoch or count, count)
    factor = max(1, (base.snippets_per_epoch or count) // per_epoch)
    return dataclasses.replace(
        base,
        seed=config.seed,
        epochs=factor * base.epochs,
        pretraining_epochs=factor * base.pretraining_epochs,
        history=config.history,
    )


def make_rows(
    methods: Mapping[tuple[str, float], Sequence[Errors]],
    masks: Mapping[str, np.ndarray],
    group: Int[np.ndarray, " n"],
    *,
    data: str,
    horizon_s: float,
    start: str,
) -> list[Row]:
    """Means, ratios to constant velocity and differences to zero-shot, with intervals.

    Args:
        methods: errors of every seed by method and share.
        masks: masks of the subsets by name.
        group: group of each snippet, over which intervals are resampled.
        data: DATA as given.
        horizon_s: horizon in seconds.
        start: name of the run that is fine-tuned.
    """
    rows = []
    reference, zero = methods[BASELINE, 0.0][0], methods[ZERO_SHOT, 0.0][0]
    for stream, ((method, share), seeds) in enumerate(methods.items()):
        for (selection, metric), subset in (
            (key, subset) for key in reference for subset in masks if masks[subset].any()
        ):
            chosen = np.flatnonzero(masks[subset])
            key = (selection, metric)
            values = np.stack([each[key][chosen] for each in seeds])
            found = {metric: (values, np.ones(len(chosen)))}
            if method != BASELINE and reference[key][chosen].any():
                found[f"{metric} / constant velocity"] = (values, reference[key][chosen])
            if method in (TUNED, SCRATCH):
                difference = values - zero[key][chosen]
                found[difference_name(metric, ZERO_SHOT)] = (difference, np.ones(len(chosen)))
            for name, (numerators, denominators) in found.items():
                estimate = statistics.ratio_over_runs(
                    numerators, denominators, group[chosen], stream=stream
                )
                rows.append(
                    Row(
                        data=data,
                        predictor=f"{method} {share:g}" if share else method,
                        trained_on="" if method == BASELINE else start,
                        horizon_s=horizon_s,
                        selection=selection,
                        subset=subset,
                        metric=name,
                        value=estimate.value,
                        low=estimate.low,
                        high=estimate.high,
                        n=estimate.n,
                        runs=len(seeds),
                    )
                )
    return rows


def table_of(rows: Sequence[Row]) -> Table:
    """FDE of moving and standing targets, and the difference to zero-shot."""
    table = Table(title="FDE m; difference to zero-shot of moving targets; 95 % intervals")
    columns = (
        ("moving", "most-probable", "FDE"),
        ("moving", "most-probable", difference_name("FDE", ZERO_SHOT)),
        ("moving", "best-of-3", "FDE"),
        ("moving", "best-of-3", difference_name("FDE", ZERO_SHOT)),
        ("standing", "most-probable", "FDE"),
    )
    table.add_column("method")
    for heading in ("moving", "difference", "best of 3", "difference", "standing"):
        table.add_column(heading, justify="right")
    by_key = {(r.predictor, r.subset, r.selection, r.metric): r for r in rows}
    for method in dict.fromkeys(row.predictor for row in rows):
        table.add_row(method, *(_cell(by_key.get((method, *column))) for column in columns))
    return table


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    text = f"{row.value:.2f}"
    return (
        text if row.low is None or row.high is None else f"{text} [{row.low:.2f}, {row.high:.2f}]"
    )


if __name__ == "__main__":
    try:
        tyro.cli(Finetuning).run()
    except AspEnvError as error:
        sys.stderr.write(f"finetuning: {error}\n")
        sys.exit(2)
