"""What predictors said of the same targets before: forecasts of consecutive snippets."""

from typing import final

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.clock import ticks
from asp_env.data.snippets import EVERY_S, SnippetIndex


@final
class Earlier:
    """The most probable forecasts of earlier snippets, as far back as later ones need them.

    Attributes:
        apart: ticks between consecutive snippets of one target.
    """

    def __init__(self, index: SnippetIndex) -> None:
        """Finds, for every snippet, the one of the same track 0.6 s before."""
        self.apart = ticks(EVERY_S, index.dt_s)
        count = len(index)
        order = np.lexsort((index.tick, index.track, index.recording))
        before, after = order[:-1], order[1:]
        follows = (index.recording[before] == index.recording[after]) & (before < after)
        follows &= index.track[before] == index.track[after]
        follows &= index.tick[before] + self.apart == index.tick[after]
        self._rows = np.full(count, -1)
        self._rows[after[follows]] = before[follows]
        needed = np.where(self._rows >= 0, self._rows, count)
        self._needed_from = np.append(np.minimum.accumulate(needed[::-1])[::-1], count)
        self._kept: dict[str, tuple[int, np.ndarray]] = {}

    def exchange(
        self, name: str, rows: slice, positions: Float[np.ndarray, "n t 2"]
    ) -> tuple[Float[np.ndarray, "n t 2"], Bool[np.ndarray, " n"]]:
        """Takes a predictor's forecasts of the next rows; gives those made before and where.

        Args:
            name: of the predictor.
            rows: the rows after those of its last call.
            positions: of the most probable modes.
        """
        first, kept = self._kept.get(name, (rows.start, positions[:0]))
        kept = np.concatenate([kept, positions])
        earlier = self._rows[rows]
        paired = earlier >= 0
        before = kept[np.where(paired, earlier - first, 0)]
        start = min(int(self._needed_from[rows.stop]), rows.stop)
        self._kept[name] = (start, kept[start - first :].copy())
        return before, paired
