"""What a run learns from and is selected on."""

from collections.abc import Sequence
from dataclasses import dataclass

from asp_env.data.causal import causal_histories
from asp_env.data.parts import TrainedOn, snippet_parts
from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.views import SceneView
from predictors.recipes import TrainingConfig
from predictors.samples import Batches, choose_snippets

VALIDATION_BATCH = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """Some snippets of some recordings."""

    recordings: Recordings
    snippets: SnippetIndex

    def batches(
        self, view: SceneView, *, size: int, later_ticks: Sequence[int], config: TrainingConfig
    ) -> Batches:
        """In their order, as a network of `config` sees them."""
        histories: Sequence[Recording] = self.recordings
        if config.history == "causal":
            histories = causal_histories(self.recordings)
        return Batches(
            self.recordings,
            self.snippets,
            view=view,
            batch_size=size,
            later_ticks=later_ticks,
            histories=histories,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """What there is for a run."""

    training: Share
    validation: Share
    trained_on: TrainedOn
    data_hash: str
    validation_hash: str | None
    """Of separate validation data, if there are any."""


def open_training_data(config: TrainingConfig, data: str) -> TrainingData:
    """Opens DATA and deals it, or takes all of it where validation data are given.

    Raises:
        AspEnvError: the data are bad, nothing is left for a part, or a recording is in both.
    """
    recordings = open_data(data)
    index = _index(recordings, config)
    if config.validation is None:
        parts, trained_on = snippet_parts(recordings, index, config.split)
        training, validation = (
            Share(recordings=recordings, snippets=index.select(parts == part))
            for part in ("train", "validation")
        )
        validation_hash = None
    else:
        others = open_data(config.validation)
        training = Share(recordings=recordings, snippets=index)
        validation = Share(recordings=others, snippets=_index(others, config))
        trained_on = _dealt_by_hand(recordings, others)
        validation_hash = others.data_hash()
    for part, share in (("training", training), ("validation", validation)):
        if not len(share.snippets):
            raise AspEnvError(
                f"data {data!r}: no snippet is left for {part} after the split by "
                f"{config.split}; give more recordings or longer ones"
            )
    return TrainingData(
        training=_chosen(training, config, config.standing_share, config.max_snippets),
        validation=_chosen(validation, config, 1.0, config.max_validation_snippets),
        trained_on=trained_on,
        data_hash=recordings.data_hash(),
        validation_hash=validation_hash,
    )


def _index(recordings: Recordings, config: TrainingConfig) -> SnippetIndex:
    return index_snippets(recordings, dt_s=config.dt_s, horizon_s=config.horizon_s)


def _dealt_by_hand(training: Recordings, validation: Recordings) -> TrainedOn:
    learned, selected = training.hashes(), validation.hashes()
    if both := set(learned) & set(selected):
        names = dict(zip(selected, validation.names, strict=True))
        raise AspEnvError(
            f"recording {names[min(both)]} of {validation.source!r} is in {training.source!r} too: "
            "select on recordings that are not learned from"
        )
    parts = dict.fromkeys(learned, "train") | dict.fromkeys(selected, "validation")
    return TrainedOn(source=training.source, split="recording", parts=parts)


def _chosen(share: Share, config: TrainingConfig, standing_share: float, most: int | None) -> Share:
    chosen = choose_snippets(
        share.recordings,
        share.snippets,
        standing_share=standing_share,
        max_snippets=most,
        seed=config.seed,
    )
    return Share(recordings=share.recordings, snippets=chosen)
