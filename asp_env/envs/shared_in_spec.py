"""Predictors in the specification of an environment, which Gymnasium copies deeply."""

from collections.abc import Mapping
from typing import Any

from gymnasium.envs.registration import EnvSpec

from asp_env.data.predictor import Predictor
from asp_env.sim.traffic.driver import Shared


class SharedInSpec:
    """An environment whose `spec` shares predictors with its copies instead of copying networks.

    A predictor object in `spec.kwargs` is held by a `Shared`, whose `value` it is and which the
    constructors accept in its place. Names stay texts, so that `spec.to_json()` works with them.
    """

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The specification that makes this environment again."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and "predictor" in spec.kwargs:
            spec.kwargs["predictor"] = shared_predictors(spec.kwargs["predictor"])
        self._spec = spec


def shared_predictors(predictor: Any) -> Any:
    """Replaces predictor objects by `Shared` ones, also in a mapping; names stay unchanged."""
    if isinstance(predictor, Mapping):
        return {name: shared_predictors(each) for name, each in predictor.items()}
    return Shared(predictor) if isinstance(predictor, Predictor) else predictor
