"""What a predictor that changes the forecasts of another one has in common with it."""

from collections.abc import Mapping
from dataclasses import dataclass

from asp_env.data.predictor import Predictor, feature_size, needs_simulation
from asp_env.data.split import TrainedOn


@dataclass(frozen=True, slots=True, kw_only=True)
class Wrapping:
    """The properties of another predictor, but for its name and its horizon."""

    inner: Predictor
    """The other predictor."""

    @property
    def dt_s(self) -> float:
        """Seconds per tick."""
        return self.inner.dt_s

    @property
    def privileged(self) -> bool:
        """Whether the other predictor is."""
        return self.inner.privileged

    @property
    def needs_simulation(self) -> bool:
        """Whether the other predictor does."""
        return needs_simulation(self.inner)

    @property
    def history(self) -> int:
        """Past ticks that the other predictor needs."""
        return self.inner.history

    @property
    def feature_size(self) -> int:
        """Number of features in the other predictor's forecasts."""
        return feature_size(self.inner)

    @property
    def trained_on(self) -> TrainedOn | None:
        """Training data of the other predictor."""
        return self.inner.trained_on

    @property
    def metadata(self) -> Mapping[str, str]:
        """That of the other predictor."""
        return self.inner.metadata
