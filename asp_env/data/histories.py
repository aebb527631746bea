"""Histories: the recordings that scenes are made from, beside the recorded ones of the labels."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, Literal, SupportsIndex, overload

from asp_env.data.causal import causal_histories
from asp_env.data.recording import Recording
from asp_env.errors import DataError

History = Literal["recorded", "causal", "accelerations"]
"""What scenes show: states as recorded, and past actions inferred from them; states filtered
without later frames; or states as recorded, and past actions with the accelerations of the files.
"""


class AccelerationHistories(Sequence[Any]):  # not of Recording: checking its items would open them
    """Recordings whose scenes show recorded accelerations, each opened on first access."""

    def __init__(self, recordings: Sequence[Any]) -> None:
        """Creates the sequence without opening any recording.

        Args:
            recordings: the recorded ones.
        """
        self._recorded = recordings
        self._opened: dict[int, Recording] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes open the recordings again."""
        return AccelerationHistories, (self._recorded,)

    def __len__(self) -> int:
        return len(self._recorded)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "AccelerationHistories": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | AccelerationHistories":
        """One recording, or a sequence of several.

        Raises:
            DataError: the recording has no accelerations.
        """
        if isinstance(index, slice):
            return AccelerationHistories(self._recorded[index])
        number = range(len(self))[index]
        if number not in self._opened:
            recording = self._recorded[number]
            if recording.accelerations is None:
                raise DataError(
                    f"recording {recording.name}: its files hold no accelerations; expected the "
                    "columns xAcceleration and yAcceleration, or lonAcceleration, in "
                    "XX_tracks.csv: use --history recorded, which infers them"
                )
            self._opened[number] = dataclasses.replace(recording, shows_accelerations=True)
        return self._opened[number]

    def __iter__(self) -> Iterator[Recording]:
        return (self[index] for index in range(len(self)))


def histories(recordings: Sequence[Any], history: History) -> Sequence[Any]:
    """The recordings to make scenes from; labels and the ground truth are always as recorded.

    Args:
        recordings: the recorded ones.
        history: what the scenes show.
    """
    if history == "causal":
        return causal_histories(recordings)
    return AccelerationHistories(recordings) if history == "accelerations" else recordings
