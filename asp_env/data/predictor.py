"""The socket for predictors, and how one is named: `name` or `name:RUN_DIR`."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from asp_env import registry
from asp_env.data.forecast import Forecast
from asp_env.data.parts import TrainedOn
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future


@runtime_checkable
class Predictor(Protocol):
    """Anything that forecasts the targets of a scene."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it is handed the recorded future; tables name such a predictor as an oracle."""
        ...

    @property
    def dt_s(self) -> float:
        """The time step of the scenes that it takes and of its forecasts."""
        ...

    @property
    def history(self) -> int:
        """Past ticks that it needs to see of a target."""
        ...

    @property
    def horizon(self) -> int:
        """Ticks that it forecasts."""
        ...

    @property
    def trained_on(self) -> TrainedOn | None:
        """What it learned from; None for one that learns nothing."""
        ...

    @property
    def about(self) -> Mapping[str, str]:
        """For tables and manifests: `trained_on`, `view`, `preset`, `weights`, as they apply."""
        ...

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the scene's targets; only privileged predictors get a future."""
        ...


@runtime_checkable
class PredictorPlug(Protocol):
    """What the registry holds under a predictor's name."""

    def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """The predictor for what stands behind the colon of its name, possibly nothing.

        Raises:
            AspEnvError: the argument is missing, superfluous, or cannot be loaded.
        """
        ...


def load_predictor(name: str, *, horizon: int, dt_s: float) -> Predictor:
    """The predictor of a name such as `constant-velocity` or `ffw-asp:runs/1`.

    Args:
        name: the registered name, and behind a colon its folder if it is a trained one.
        horizon: ticks to forecast, for predictors that can forecast any number; a trained one
            keeps its own.
        dt_s: the time step of the scenes to come.

    Raises:
        AspEnvError: the name is unknown, or the predictor cannot be made for it.
    """
    kind, _, argument = name.partition(":")
    plug: PredictorPlug = registry.find("predictors", kind)
    return plug.from_name(argument, horizon=horizon, dt_s=dt_s)
