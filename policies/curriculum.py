"""A curriculum: scenarios that are easy by one of their columns come first."""

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asp_env.data.scenarios.scenario import ScenarioSet

FIRST_SHARE = 0.3
"""Share of the scenarios at the start of the training. Chosen by hand."""

GROWTH = 0.5
"""Share of the training after which all scenarios are drawn. Chosen by hand."""


class Curriculum(BaseCallback):
    """Draws the first scenarios in the order of a column, and more of them as training goes on."""

    def __init__(self, column: str, steps: int) -> None:
        """Chooses the order.

        Args:
            column: column of the scenarios, the smallest first; with a minus sign before it, the
                largest first.
            steps: steps of the whole training.
        """
        super().__init__()
        self._column, self._steps = column, steps
        self._ordered: ScenarioSet | None = None
        self._drawn = 0

    def _on_training_start(self) -> None:
        scenarios: ScenarioSet = self.training_env.get_attr("scenarios", 0)[0]
        self._ordered = ordered(scenarios, self._column)
        self._update()

    def _on_rollout_end(self) -> None:
        self._update()

    def _on_step(self) -> bool:
        return True

    def _update(self) -> None:
        assert self._ordered is not None
        count = number_drawn(len(self._ordered), self.num_timesteps / self._steps)
        if count != self._drawn:
            self._drawn = count
            self.training_env.set_attr("scenarios", self._ordered.select(np.arange(count)))
        self.logger.record("curriculum/scenarios", count)


def ordered(scenarios: ScenarioSet, column: str) -> ScenarioSet:
    """All scenarios in the order of a column.

    Args:
        scenarios: the scenarios.
        column: its name; a minus sign before it reverses the order.

    Raises:
        AspEnvError: the column is unknown.
    """
    return scenarios.sorted_by(column.removeprefix("-"), descending=column.startswith("-"))


def number_drawn(count: int, share_done: float) -> int:
    """Number of scenarios that are drawn after a share of the training.

    Args:
        count: number of all scenarios.
        share_done: share of the training that is done.
    """
    share = FIRST_SHARE + (1.0 - FIRST_SHARE) * min(share_done / GROWTH, 1.0)
    return max(1, round(share * count))
